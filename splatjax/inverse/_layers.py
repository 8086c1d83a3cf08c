"""Pictures of one body with all their layers, which serve many materials."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.gaussians import SumOfGaussians
from splatjax.render import DiffusionBasis, Plan, RenderSettings, diffusion_basis, make_plan
from splatjax.scattering import Medium
from splatjax.scene import Camera, Material, Scene, Splats

from ._observation import Observation

_LARGER = 3.0
"""Of a wide range: the ratio of neighboring variances. It leaves dipoles an error of 0.2%."""
_NARROWEST, _WIDEST = 0.05, 200.0
"""Squared mean free paths: where the Gaussians of a dipole's fit lie, and beyond."""
_GRID = math.log(1.15)
"""Between the log variances that plans are made for; a plan holds for more than that."""
_REACH = 10.0
"""In variance: of coefficients that are off by a factor of three at the start."""


def make_plans(
    scenes: Sequence[Scene], cameras: Sequence[Camera], settings: RenderSettings
) -> list[Plan]:
    """Make a plan for each scene with its camera. Pictures that may share one do, so that nothing
    is compiled twice.
    """
    keys = [
        (camera.width, camera.height, jax.tree.structure(scene.lights))
        for scene, camera in zip(scenes, cameras, strict=True)
    ]
    plans = {}
    for key in dict.fromkeys(keys):
        alike = [i for i, other in enumerate(keys) if other == key]
        plans[key] = make_plan([scenes[i] for i in alike], [cameras[i] for i in alike], settings)
    return [plans[key] for key in keys]


def render_layers(
    splats: Splats,
    material: Material,
    observations: Sequence[Observation],
    settings: RenderSettings,
    plans: list[Plan] | None = None,
    derivative: bool = True,
) -> tuple[list[DiffusionBasis], list[Plan]]:
    """Render all that weights do not change, one picture after the other.

    **Arguments:**

    - `plans`: used if they suffice.
    - `derivative`: whether variances may be a little off those of the material.

    **Returns:** the pictures, and the plans that they were rendered with.
    """
    cameras = [one.camera for one in observations]

    def scenes_of(material):
        return [Scene(splats, one.lights, material) for one in observations]

    def render(plans):
        together = zip(scenes_of(material), cameras, plans, strict=True)
        return [
            jax.block_until_ready(diffusion_basis(scene, camera, settings, plan, derivative))
            for scene, camera, plan in together
        ]

    pictures = render(plans) if plans else []
    if not pictures or any(float(picture.overflow) > 0 for picture in pictures):
        # On a coarse grid, so that nearly equal materials have plans of the same shapes, and one
        # program.
        variances = material.gaussians.variances
        rounded = jnp.exp(jnp.round(jnp.log(variances) / _GRID) * _GRID)
        rounded = SumOfGaussians(rounded, material.gaussians.weights)
        plans = make_plans(scenes_of(material.surface_of(rounded)), cameras, settings)
        pictures = render(plans)
    return pictures, plans or []


def wide_variances(media: Sequence[Medium], splats: Splats) -> Float[Array, " gaussians"]:
    r"""Choose variances (mm^2) that serve all media near some: each three times the one before.

    They hold what coefficients up to three times as large, or as small, make of a dipole. None is
    much wider than the body.
    """
    paths = np.concatenate([1 / np.asarray(medium.sigma_t_prime, np.float64) for medium in media])
    root = np.concatenate([np.asarray(medium.squared_sigma_tr, np.float64) for medium in media])
    squared_diffuse = 1 / np.maximum(root, 1e-12)
    low = _NARROWEST * np.min(paths**2) / _REACH
    high = np.max(np.maximum(_WIDEST * paths**2, 3 * squared_diffuse)) * _REACH
    size = float(np.sum(np.var(np.asarray(splats.centers, np.float64), axis=0)))
    high = max(min(high, size), _LARGER * low)
    count = max(2, math.ceil(math.log(high / low) / math.log(_LARGER)) + 1)
    return jnp.asarray(low * _LARGER ** np.arange(count), media[0].sigma_a.dtype)
