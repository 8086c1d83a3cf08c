"""Media of the tests."""

import splatjax as sj

INFINITE = float("inf")


def layer(sigma_a, sigma_s_prime, eta, thickness=INFINITE) -> sj.Layer:
    return sj.Layer(sj.Medium(sigma_a, sigma_s_prime, eta), thickness)
