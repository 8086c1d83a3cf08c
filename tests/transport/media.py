"""Media of the tests, and where their light goes."""

import jax.numpy as jnp

import splatjax as sj

INFINITE = float("inf")


def layer(sigma_a, sigma_s_prime, eta, thickness=INFINITE) -> sj.Layer:
    return sj.Layer(sj.Medium(sigma_a, sigma_s_prime, eta), thickness)


def balance(found: sj.transport.MonteCarlo):
    """All light that is accounted for, less 1: rounding, and the chance by which faint photons are
    given up.
    """
    parts = (found.total_reflectance, found.total_transmittance, found.unfinished)
    return sum(part.value for part in parts) + jnp.sum(found.absorbed.value, axis=0) - 1
