"""The optical coefficients of a homogeneous scattering medium."""

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


class Medium(eqx.Module):
    r"""A homogeneous medium under the diffusion approximation.

    **Attributes:** (any number of channels; all differentiable)

    - `sigma_a`: absorption coefficient, 1/mm, at least 0.
    - `sigma_s_prime`: reduced scattering coefficient, 1/mm, positive.
    - `eta`: index of refraction relative to air.

    **Raises:** `ValueError` for a value out of these ranges. Under `jit` values are unknown, and
    not checked.
    """

    sigma_a: Float[Array, " channels"]
    sigma_s_prime: Float[Array, " channels"]
    eta: Float[Array, " channels"]

    def __check_init__(self):
        check_range("sigma_a", self.sigma_a, "at least 0 (1/mm)", lambda x: x >= 0)
        check_range("sigma_s_prime", self.sigma_s_prime, "positive (1/mm)", lambda x: x > 0)
        check_range("eta", self.eta, "positive", lambda x: x > 0)

    @property
    def sigma_t_prime(self) -> Float[Array, " channels"]:
        """Reduced extinction coefficient, 1/mm."""
        return self.sigma_a + self.sigma_s_prime

    @property
    def albedo_prime(self) -> Float[Array, " channels"]:
        """Reduced single-scattering albedo."""
        return self.sigma_s_prime / self.sigma_t_prime

    @property
    def squared_sigma_tr(self) -> Float[Array, " channels"]:
        """Square of the effective transport coefficient, `3 sigma_a sigma_t'`, 1/mm^2: smooth where
        `sigma_a = 0`.
        """
        return 3 * self.sigma_a * self.sigma_t_prime


def check_range(name: str, value, expected: str, holds, finite: bool = True) -> None:
    """Raise if a known value is out of range; a traced one passes."""
    if isinstance(value, Tracer) or not isinstance(value, (jax.Array, np.ndarray)):
        return
    known = np.asarray(value)
    possible = np.isfinite(known) if finite else ~np.isnan(known)
    if known.dtype.kind == "f" and not np.all(possible & holds(known)):
        raise ValueError(
            f"{name} must be {'finite and ' if finite else ''}{expected}; got {known.tolist()}"
        )
