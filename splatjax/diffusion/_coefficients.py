"""The coefficients of the diffusion equation in a medium, and of its boundary."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import ExactFresnel, Medium

_MILNE = 0.710446  # extrapolation distance of the Milne problem, mean free paths, times albedo
_LEAST_ALBEDO = 0.1  # lower bound of the albedo by which `z_e` is divided


class DiffusionCoefficients(eqx.Module):
    r"""Coefficients of the diffusion equation and its boundary, one for each channel.

    Far from boundaries and beams the solutions decay as those of light transport do: `kappa` is
    Case's discrete eigenvalue, `kappa / sigma_t = tanh(kappa / sigma_s)`, within 0.2% for albedos
    above 0.5, and `D = sigma_a / kappa^2`.

    **Attributes:**

    - `sigma_t`: reduced extinction coefficient, 1/mm.
    - `albedo`: reduced.
    - `diffusion_coefficient`: `D`, mm.
    - `squared_kappa`: 1/mm^2.
    - `z_e`: extrapolation distance, mm.
    - `excess`: fluence of an isotropic source beyond that which diffuses, integrated over space,
      mean free paths. Fitted to the transmittance of a slab of eight mean free paths.
    - `lasting`: the fraction of an isotropic source that diffuses; the rest is absorbed within
      about a mean free path.
    - `inward`: fluence over the irradiance of uniform light that enters, in equilibrium.

    **Source:** Case and Zweifel 1967, "Linear Transport Theory".
    """

    sigma_t: Float[Array, "*channels"]
    albedo: Float[Array, "*channels"]
    diffusion_coefficient: Float[Array, "*channels"]
    squared_kappa: Float[Array, "*channels"]
    z_e: Float[Array, "*channels"]
    excess: Float[Array, "*channels"]
    lasting: Float[Array, "*channels"]
    inward: Float[Array, "*channels"]

    @classmethod
    def of(cls, medium: Medium | None) -> "DiffusionCoefficients":
        assert medium is not None
        fresnel, sigma_t, albedo = ExactFresnel(), medium.sigma_t_prime, medium.albedo_prime
        loss = medium.sigma_a / sigma_t
        diffusion = (1 + loss * (0.45 + 0.5 * loss)) / (3 - 1.05 * loss) / sigma_t
        inward = 4 / (1 - fresnel.first_moment(medium.eta))
        z_e = _MILNE / 4 * (1 + fresnel.second_moment(medium.eta)) * inward
        z_e = z_e / (sigma_t * jnp.maximum(albedo, _LEAST_ALBEDO))
        # An absorbing half space then reflects uniform light as Chandrasekhar's H function does.
        inward = inward * (1 + 4.5 * loss) / (1 + 4.95 * loss)
        excess, squared_kappa = 0.53 + 0.265 * loss, medium.sigma_a / diffusion
        lasting = 1 - loss * excess
        return cls(sigma_t, albedo, diffusion, squared_kappa, z_e, excess, lasting, inward)
