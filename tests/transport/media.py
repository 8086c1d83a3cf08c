"""Media of the tests."""

import jax.numpy as jnp

import splatjax as sj

INFINITE = float("inf")


def layer(sigma_a, sigma_s_prime, eta, thickness=INFINITE) -> sj.Layer:
    """Give a layer of as many channels as there are values of `sigma_a`."""
    sigma_a = jnp.atleast_1d(jnp.asarray(sigma_a, jnp.zeros(()).dtype))
    like = jnp.ones_like(sigma_a)
    return sj.Layer(sj.Medium(sigma_a, sigma_s_prime * like, eta * like), jnp.asarray(thickness))
