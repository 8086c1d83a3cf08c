"""What a translucent surface is made of."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.gaussians import SumOfGaussians


class Material(eqx.Module):
    r"""A translucent material: how light spreads below the surface, and how the surface itself reflects.

    **Attributes:** (all differentiable)

    - `gaussians`: the diffusion profile; the picture's diffuse reflectance is the sum of its weights.
    - `eta`: index of refraction relative to air, for the Fresnel term of the specular lobe.
    - `specular`: strength of the specular lobe (rho_s).
    - `roughness`: of the specular lobe (m, root mean square slope), in (0, 1].
    """

    gaussians: SumOfGaussians
    eta: Float[Array, ""]
    specular: Float[Array, ""]
    roughness: Float[Array, ""]

    def __init__(self, gaussians: SumOfGaussians, eta=1.4, specular=0.18, roughness=0.3):
        dtype = gaussians.variances.dtype
        self.gaussians = gaussians
        self.eta = jnp.asarray(eta, dtype)
        self.specular = jnp.asarray(specular, dtype)
        self.roughness = jnp.asarray(roughness, dtype)

    def white(self) -> "Material":
        """Give the material with weights that sum to one per channel, so that an albedo map alone carries color."""
        return Material(self.gaussians.white(), self.eta, self.specular, self.roughness)
