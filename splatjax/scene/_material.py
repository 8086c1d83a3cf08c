"""What a translucent surface is made of."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._records import check_values, numbers, record
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import SingleScattering

_NARROW = 1e-6  # mm^2: far below any splat, so that the layer is unresolved


@record
class Material(eqx.Module):
    r"""A translucent material: how light spreads below the surface, and how the surface itself
    reflects.

    **Attributes:** (all differentiable)

    - `gaussians`: the diffusion profile; the picture's diffuse reflectance is the sum of its
      weights.
    - `eta`: index of refraction relative to air, for the Fresnel term of the specular lobe.
    - `specular`: strength of the specular lobe (rho_s).
    - `roughness`: of the specular lobe (m, root mean square slope), at least 0.
    - `single_scattering`: light that scatters once, as a term of its own; the Gaussians then stand
      for the rest. `None`: they stand for all.
    """

    gaussians: SumOfGaussians
    eta: Float[Array, ""] = eqx.field(converter=numbers, default=1.4)
    specular: Float[Array, ""] = eqx.field(converter=numbers, default=0.18)
    roughness: Float[Array, ""] = eqx.field(converter=numbers, default=0.3)
    single_scattering: SingleScattering | None = None

    def __check_init__(self):
        check_values("Material.eta", self.eta, "positive", lambda x: x > 0)
        check_values("Material.specular", self.specular, "at least 0", lambda x: x >= 0)
        check_values("Material.roughness", self.roughness, "at least 0", lambda x: x >= 0)

    @property
    def channels(self) -> int:
        return self.gaussians.channels

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the light entering a flat piece along its normal that leaves it
        again.
        """
        total = self.gaussians.total_reflectance()
        if self.single_scattering is None:
            return total
        return total + self.single_scattering.total_reflectance()

    def diffuse_fraction(self, mu_i: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute the factor on the Gaussians for light that enters under the cosine `mu_i`; 1
        along the normal.

        Grazing light leaves after one scattering more often than light along the normal. Where that
        and the total reflectance of the Gaussians would exceed 1, the Gaussians are scaled to the
        difference.
        """
        if self.single_scattering is None:
            return jnp.ones((*mu_i.shape, self.channels), mu_i.dtype)
        left = jnp.maximum(1 - self.single_scattering.directional_albedo(mu_i), 0)
        total = jnp.broadcast_to(self.gaussians.total_reflectance(), left.shape)
        return jnp.where(left < total, left / jnp.where(left < total, total, 1.0), 1.0)

    def surface_of(self, gaussians: SumOfGaussians) -> "Material":
        """Return a material of other Gaussians with this surface, without single scattering."""
        return Material(gaussians, self.eta, self.specular, self.roughness)

    def opaque(self) -> "Material":
        """Return the material without scattering below the surface: one Gaussian narrower than any
        splat has the total reflectance.
        """
        variances = jnp.full_like(self.gaussians.variances, _NARROW, shape=(1,))
        return self.surface_of(SumOfGaussians(variances, self.total_reflectance()[None]))

    def white(self) -> "Material":
        """Scale the total reflectance to one in every channel, so that an albedo map alone carries
        color.
        """
        total, single = self.total_reflectance(), self.single_scattering
        gaussians = SumOfGaussians(self.gaussians.variances, self.gaussians.weights / total[None])
        if single is not None:
            single = SingleScattering(single.medium, single.strength / total)
        return Material(gaussians, self.eta, self.specular, self.roughness, single)
