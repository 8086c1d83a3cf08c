"""Normalized diffusion."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record, valid
from splatjax.gaussians import AbstractProfile


class AbstractBurleyScaling(eqx.Module):
    """A published curve `s(albedo)`: the free path over the length of the profile."""

    @abc.abstractmethod
    def __call__(self, albedo: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute `s`, positive; without unit."""


class Searchlight(AbstractBurleyScaling):
    """For light that enters as a beam; lengths are in mean free paths. **Source:** Christensen and
    Burley 2015.
    """

    def __call__(self, albedo):
        return 1.85 - albedo + 7 * jnp.abs(albedo - 0.8) ** 3


class DiffuseTransmission(AbstractBurleyScaling):
    """For light that enters diffusely; lengths are in mean free paths. **Source:** Christensen and
    Burley 2015, Eq. 6.
    """

    def __call__(self, albedo):
        return 1.9 - albedo + 3.5 * (albedo - 0.8) ** 2


class DiffuseMeanFreePath(AbstractBurleyScaling):
    """For light that enters as a beam; lengths are diffuse mean free paths. **Source:** Christensen
    and Burley 2015.
    """

    def __call__(self, albedo):
        return 3.5 + 100 * (albedo - 0.33) ** 4


@record
class Burley(AbstractProfile):
    r"""Two exponentials that approximate Monte Carlo profiles, single scattering included.

        R(r) = A (exp(-r / d) + exp(-r / 3d)) / (8 pi d r),  d = free_path / s(A)

    It diverges like 1/r at the origin: Eq. 3 is computed beyond a cut. Differentiable for `r > 0`.

    **Attributes:**

    - `albedo`: surface albedo A, the total reflectance, in [0, 1].
    - `free_path`: mm, positive.
    - `scaling`: the kind of free path, and the entry of light: `Searchlight()` by default.

    **Source:** Christensen and Burley 2015, "Approximate reflectance profiles for efficient
    subsurface scattering".
    """

    albedo: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("in [0, 1]", lambda x: (x >= 0) & (x <= 1))
    )
    free_path: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("positive (mm)", lambda x: x > 0)
    )
    scaling: AbstractBurleyScaling = Searchlight()

    singular: ClassVar[bool] = True

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (*r.shape, *self.albedo.shape)
        radius = jnp.broadcast_to(r[..., None], shape)
        d = jnp.broadcast_to(self.length_scale(), shape)
        exponentials = jnp.exp(-radius / d) + jnp.exp(-radius / (3 * d))
        return jnp.broadcast_to(self.albedo, shape) * exponentials / (8 * jnp.pi * d * radius)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.albedo

    def length_scale(self) -> Float[Array, " channels"]:
        """Compute `d`, mm."""
        return self.free_path / self.scaling(self.albedo)
