"""Media of the tests."""

import splatjax as sj

INFINITE = float("inf")


def layer(sigma_a, sigma_s_prime, eta, thickness=INFINITE) -> sj.Layer:
    """Make a layer of as many channels as there are values of `sigma_a`."""
    return sj.Layer(sj.Medium(sigma_a, sigma_s_prime, eta), thickness)
