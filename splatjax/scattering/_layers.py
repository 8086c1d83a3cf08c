"""What a layered material is made of."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._medium import Medium, check_range


class Layer(eqx.Module):
    r"""A slab of a scattering medium.

    **Attributes:** (differentiable)

    - `medium`: its coefficients, [channels].
    - `thickness`: mm; infinite for the lowest layer of a half space.

    **Raises:** `ValueError` for a negative thickness.
    """

    medium: Medium
    thickness: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        check_range("thickness", self.thickness, "at least 0 (mm)", lambda x: x >= 0, finite=False)

    def check_diffusion(self) -> None:
        """Raise if diffusion does not know such a slab: the light would come from outside of it. A
        traced one passes.
        """
        check_range(
            "thickness in mean free paths, thickness * sigma_t',",
            self.thickness.astype(self.medium.sigma_a.dtype) * self.medium.sigma_t_prime,
            "at least 1 in every channel: diffusion does not hold in a thinner layer; monte_carlo "
            "does, and a Film absorbs "
            "and scatters nothing",
            lambda x: x >= 1 - 1e-6,
            finite=False,
        )


class Film(eqx.Module):
    r"""A layer that absorbs and does not scatter, thinner than anything the light spreads over.

    Light that comes from outside as a beam keeps `exp(-t)` of its power, diffuse light `2 E3(t)`,
    with t the optical depth.

    **Attributes:**

    - `optical_depth`: absorption coefficient times thickness, at least 0. Differentiable.

    **Source:** diffuse transmittance: the integral of `2 mu exp(-t / mu)` over the cosine.
    """

    optical_depth: Float[Array, " channels"]

    def __check_init__(self):
        check_range("optical_depth", self.optical_depth, "at least 0", lambda x: x >= 0)
