"""The optical coefficients of a homogeneous scattering medium."""

import equinox as eqx
from jaxtyping import Array, Float


class Medium(eqx.Module):
    r"""A homogeneous medium under the diffusion approximation.

    **Attributes:** (any number of channels; all differentiable)

    - `sigma_a`: absorption coefficient, 1/mm, at least 0.
    - `sigma_s_prime`: reduced scattering coefficient, 1/mm, positive.
    - `eta`: index of refraction relative to air.
    """

    sigma_a: Float[Array, " channels"]
    sigma_s_prime: Float[Array, " channels"]
    eta: Float[Array, " channels"]

    @property
    def sigma_t_prime(self) -> Float[Array, " channels"]:
        """Reduced extinction coefficient, 1/mm."""
        return self.sigma_a + self.sigma_s_prime

    @property
    def albedo_prime(self) -> Float[Array, " channels"]:
        """Reduced single-scattering albedo."""
        return self.sigma_s_prime / self.sigma_t_prime
