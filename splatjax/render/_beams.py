"""The beams that enter the splats, for the diffusion equation in a body."""

import jax.numpy as jnp

from splatjax import diffusion as _diffusion, shading as _shading
from splatjax.scene import Scene

from ._lighting import Irradiance, LightVisibility, surface_parameters

_GRAZING = 1e-3  # cosine


def beams_at_splats(
    scene: Scene, light: LightVisibility, irradiance: Irradiance
) -> _diffusion.Beams:
    """Refract the light that enters every splat, and sum it to one beam for each.

    **Arguments:**

    - `irradiance`: from `irradiance_at_splats`.
    """
    splats, material = scene.splats, scene.material
    f0, (_, roughness) = _shading.fresnel_f0(material.eta), surface_parameters(scene)

    def along(axis: int):
        def enters(wi, cosine):
            fraction = 1 - _shading.directional_albedo(cosine, f0, roughness)
            sine = jnp.minimum((1 - cosine * cosine) / (material.eta * material.eta), 1 - _GRAZING)
            inward = jnp.sqrt(1 - sine) - cosine / material.eta
            return (-fraction * (wi[:, axis] / material.eta + inward * splats.normals[:, axis]))[
                None
            ]

        given = splats.centers, splats.normals, light.groups, light.visibility
        return _shading.sum_received(*given, enters, material.channels)

    entering = irradiance.entering
    directions = jnp.stack([along(axis) for axis in range(3)], axis=1)
    directions = directions / jnp.where(entering > 0, entering, 1.0)[:, None]
    return _diffusion.Beams(irradiance.source, directions)
