"""Media of the tests, what their surfaces reflect, and where their light goes."""

import jax.numpy as jnp
import numpy as np

import splatjax as sj

INFINITE = float("inf")


def layer(sigma_a, sigma_s_prime, eta, thickness=INFINITE) -> sj.Layer:
    return sj.Layer(sj.Medium(sigma_a, sigma_s_prime, eta), thickness)


def reflectance(mu: float, eta: float) -> float:
    """Fresnel's equations for unpolarized light from inside, with total internal reflection."""
    squared_sine = eta * eta * (1 - mu * mu)
    if squared_sine >= 1:
        return 1.0
    outside = np.sqrt(1 - squared_sine)
    across = (eta * mu - outside) / (eta * mu + outside)
    along = (mu - eta * outside) / (mu + eta * outside)
    return 0.5 * (across**2 + along**2)


def balance(found: sj.transport.MonteCarlo):
    """All light that is accounted for, less 1: rounding, and the chance by which faint photons are
    given up.
    """
    parts = (found.total_reflectance, found.total_transmittance, found.unfinished)
    return sum(part.value for part in parts) + jnp.sum(found.absorbed.value, axis=0) - 1
