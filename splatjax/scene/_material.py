"""What a translucent surface is made of."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import SingleScattering

_NARROW = 1e-6  # mm^2: far below any splat, so that the surface's own light stands for the layer


class Material(eqx.Module):
    r"""A translucent material: how light spreads below the surface, and how the surface itself
    reflects.

    **Attributes:** (all differentiable)

    - `gaussians`: the diffusion profile; the picture's diffuse reflectance is the sum of its
      weights.
    - `eta`: index of refraction relative to air, for the Fresnel term of the specular lobe.
    - `specular`: strength of the specular lobe (rho_s).
    - `roughness`: of the specular lobe (m, root mean square slope), in (0, 1].
    - `single_scattering`: light that scatters once, as a term of its own; the Gaussians then stand
      for the rest. `None`: they stand for all.
    """

    gaussians: SumOfGaussians
    eta: Float[Array, ""]
    specular: Float[Array, ""]
    roughness: Float[Array, ""]
    single_scattering: SingleScattering | None

    def __init__(
        self,
        gaussians: SumOfGaussians,
        eta=1.4,
        specular=0.18,
        roughness=0.3,
        single_scattering: SingleScattering | None = None,
    ):
        dtype = gaussians.variances.dtype
        self.gaussians = gaussians
        self.eta = jnp.asarray(eta, dtype)
        self.specular = jnp.asarray(specular, dtype)
        self.roughness = jnp.asarray(roughness, dtype)
        self.single_scattering = single_scattering

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Give the share of the light that enters along the normal of a flat piece and leaves it
        again.
        """
        total = self.gaussians.total_reflectance()
        return (
            total
            if self.single_scattering is None
            else total + self.single_scattering.total_reflectance()
        )

    def left_to_diffuse(self, mu_i: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Give what the Gaussians have of the light that enters under a cosine `mu_i`, over what
        they have along the normal.

        Light that grazes scatters out again at once, more of it than along the normal. Where that
        and the Gaussians' total would be more than all, the Gaussians have what is left.
        """
        if self.single_scattering is None:
            return jnp.ones((*mu_i.shape, self.gaussians.weights.shape[1]), mu_i.dtype)
        total = self.gaussians.total_reflectance()
        rest = jnp.maximum(1 - self.single_scattering.leaving(mu_i), 0)
        total = jnp.broadcast_to(total, rest.shape)
        return jnp.where(rest < total, rest / jnp.where(rest < total, total, 1.0), 1.0)

    def surface_of(self, gaussians: SumOfGaussians) -> "Material":
        """Give other Gaussians, and nothing besides, the surface of this material."""
        return Material(gaussians, self.eta, self.specular, self.roughness)

    def opaque(self) -> "Material":
        """Give the same surface and color with light that leaves where it enters: one Gaussian,
        narrower than any splat.
        """
        variances = jnp.full_like(self.gaussians.variances, _NARROW, shape=(1,))
        return self.surface_of(SumOfGaussians(variances, self.total_reflectance()[None]))

    def white(self) -> "Material":
        """Give the material with a total reflectance of one per channel, so that an albedo map
        alone carries color.
        """
        single = self.single_scattering
        if single is None:
            return self.surface_of(self.gaussians.white())
        total = self.total_reflectance()
        gaussians = SumOfGaussians(self.gaussians.variances, self.gaussians.weights / total[None])
        single = SingleScattering(single.medium, single.strength / total)
        return Material(gaussians, self.eta, self.specular, self.roughness, single)
