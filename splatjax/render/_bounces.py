"""Pass 4 on the splats, and light that leaves the body and enters it again."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax import diffusion as _diffusion
from splatjax._combination import AbstractCombination
from splatjax.scene import Scene
from splatjax.shading import albedo_root, average_transmission, fresnel_f0

from ._lighting import Irradiance, surface_parameters
from ._plan import Plan
from ._settings import RenderSettings


def check_no_bounces(settings: RenderSettings) -> None:
    """Raise `ValueError` for bounces, with which a picture is not linear in the weights."""
    if settings.bounces:
        raise ValueError(
            f"settings.bounces is {settings.bounces}, and each bounce depends on the material's "
            "weights; give bounces=0, or differentiate splatjax.render in reverse mode"
        )


def bounced_irradiance(
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    direct: Irradiance,
    beams: Callable[[], _diffusion.Beams],
) -> tuple[Irradiance, Float[Array, "channels splats"] | None, Float[Array, ""]]:
    r"""Compute the light that enters every splat, directly from the lights and after bounces,

        E_n = E_0 + t F M(E_(n - 1))

    where `M(E)` is the radiant exitance of diffused light, `F M` the irradiance that the body
    receives from itself, and t the fraction of it that enters. Light that scatters once is treated
    as diffused.

    **Arguments:**

    - `direct`: `E_0`; and `beams`, which computes its beams for `AbstractDiffusionPlan.light`.

    **Returns:** the irradiance, the part of its source that has bounced, `None` without bounces,
    and the capacity needed of pass 4.
    """
    none = jnp.zeros((), direct.entering.dtype)
    if not settings.bounces:
        return direct, None, none
    sightlines, material = plan.sightlines, scene.material
    if sightlines is None:
        raise ValueError(
            f"settings.bounces is {settings.bounces}, and the plan was made with 0; make it with "
            "the same settings"
        )
    at = sightlines.first_splats()
    splats, gaussians = scene.splats, material.gaussians
    area, albedo = splats.areas[at], splats.albedo
    root = jnp.ones_like(direct.source) if albedo is None else albedo_root(albedo.T)
    _, roughness = surface_parameters(scene)
    weights = _diffusion.Sources.of(splats, direct.source).weights
    enters = average_transmission(fresnel_f0(material.eta), roughness, material.angular_law())
    enters = enters.reshape(material.channels, -1)
    # The Gaussians also represent light that scatters once: for direct light where it leaves, for
    # bounced light where it enters.
    whole, diffused = material.total_reflectance(), gaussians.total_reflectance()
    added = (whole / jnp.where(diffused > 0, diffused, 1.0))[:, None]

    def bounce(so_far, _):
        bounced, needed = so_far
        source = (added * direct.entering + bounced) * root
        given = splats, material, source, beams, settings.kernel, combination, at
        diffused, _ = plan.diffusion.light(*given, bounced * root)
        weighed, _ = _diffusion.LayersAtPoints.of(
            gaussians.variances,
            plan.diffusion.gaussians,
            diffused.layers.values,
            None,
            source[:, at],
            jnp.where(area > 0, area, 1.0),
            root[:, at] ** 2,
            plan.interval,
            settings.kernel,
            None if weights is None else weights[..., at],
        ).weigh(gaussians, material.single_scattering_albedo())
        exitance = root[:, at] * jnp.sum(gaussians.weights[:, :, None] * weighed, axis=0)
        received = sightlines.irradiance(exitance, splats.normals, combination)
        return (added * enters * received, jnp.maximum(needed, diffused.needed)), None

    start = jnp.zeros_like(direct.entering), none
    (bounced, needed), _ = jax.lax.scan(bounce, start, None, length=settings.bounces)
    # Without albedo its root is one.
    entering = direct.entering + bounced
    return Irradiance(entering, entering * root), bounced * root, needed


def diffuse_splats(
    scene: Scene,
    source: Float[Array, "channels splats"],
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    at: Int[Array, " chosen"] | None = None,
    derivative: bool = False,
):
    """Diffuse (pass 4): return the layers of the splats, their derivatives in the logarithms of
    the variances, and the capacity needed.
    """
    sources, variances = (
        _diffusion.Sources.of(scene.splats, source),
        scene.material.gaussians.variances,
    )
    given = sources, variances, settings.kernel, combination, at
    if not derivative:
        diffused = plan.diffusion.diffuse(*given)
        return diffused.layers, None, diffused.needed
    diffused, differentiated = plan.diffusion.diffuse_with_derivative(*given)
    return diffused.layers, differentiated.layers, diffused.needed
