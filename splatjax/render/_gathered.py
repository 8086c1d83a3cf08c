"""A picture for any weights: everything that they do not change is rendered once."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.devices import Devices
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Camera, Scene

from ._inputs import check_channels, in_one_dtype
from ._lighting import let_light_in
from ._passes import (
    BoundsOf,
    SeenSurfaces,
    bounds_over,
    cast_shadows,
    see_surfaces,
    shade,
    sources_of,
)
from ._plan import plan_unless_traced
from ._records import Plan
from ._settings import RenderSettings
from ._sharded import of_all, over


class GatheredPicture(eqx.Module):
    r"""What `beauty` is made of, for weights that are still to come.

    Its points are those that the pixels see: of the surface in front, and of the one that shows
    behind its silhouettes.

    **Attributes:**

    - `light`: the layers at every point.
    - `leaving`: from radiant exitance to what the pixel has of it, with the point's share of the
      pixel; 0 where no point is.
    - `pixels`: the pixel of each point, counted row by row.
    - `in_front`: 1 for a point of the surface in front, else 0.
    - `specular`: radiance, premultiplied.
    - `coverage`: in [0, 1].
    - `overflow`: as in a `Frame`; where it is above 0, pictures are NaN.
    """

    light: _diffusion.GatheredLight
    leaving: Float[Array, "#channels points"]
    pixels: Int[Array, " points"]
    in_front: Float[Array, " points"]
    specular: Float[Array, "height width channels"]
    coverage: Float[Array, "height width"]
    overflow: Float[Array, ""]

    def beauty(self, gaussians: SumOfGaussians) -> Float[Array, "height width channels"]:
        """Give the picture that `render` makes of these Gaussians. Differentiable, in every mode.

        **Arguments:**

        - `gaussians`: the variances count as those that were rendered; with slopes they may be a
          little off, to first order.
        """
        radiance = self.leaving * self.light.exitance(gaussians)
        height, width, channels = self.specular.shape
        diffuse = (
            jnp.zeros((channels, height * width), radiance.dtype).at[:, self.pixels].add(radiance)
        )
        return diffuse.T.reshape(height, width, channels) + self.specular


def gather_picture(
    scene: Scene, camera: Camera, settings: RenderSettings | None = None, plan: Plan | None = None
) -> GatheredPicture:
    r"""Render everything that the weights of the material do not change: the picture of all
    materials with its variances.

    It costs about what the picture does. Many materials can then be looked at, differentiated or
    fitted in a moment each.

    **Arguments:** as for `render`; the weights of `scene.material` do not matter.

    **Returns:** a `GatheredPicture`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render`, and for a material with single scattering, beside which
    the light that enters depends on the weights.
    """
    return _gather_any(scene, camera, settings, plan, _diffusion.gather_light)


def gather_picture_and_slopes(
    scene: Scene, camera: Camera, settings: RenderSettings | None = None, plan: Plan | None = None
) -> GatheredPicture:
    """Render as `gather_picture`, and differentiate the layers in their variances: about two and a
    half frames.

    The picture then has the derivatives of `picture_jacobian`, and those behind it, by weights and
    variances that are made of anything.
    """
    return _gather_any(scene, camera, settings, plan, _diffusion.gather_light_and_slopes)


def _gather_any(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings | None,
    plan: Plan | None,
    gather: _diffusion.Gather,
) -> GatheredPicture:
    settings = RenderSettings() if settings is None else settings
    check_channels(scene)
    if scene.material.single_scattering is not None:
        raise ValueError(
            "scene.material has single scattering, beside which less light enters as the weights "
            "grow; "
            "render each material by itself, or give one without: single_scattering=None"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    return _gather(scene, camera, settings, plan, gather)


@eqx.filter_jit
def _gather(
    scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan, gather: _diffusion.Gather
) -> GatheredPicture:
    scene, camera = in_one_dtype(scene, camera)
    if plan.mesh is None:
        return _pictured(*_in_tiles(scene, camera, settings, plan, gather))

    def share(devices: Devices, scene: Scene, plan: Plan, camera: Camera) -> GatheredPicture:
        light, tiles, seen, needed = _in_tiles(
            scene, camera, settings, plan, gather, bounds_over(devices)
        )
        return _pictured(
            light.of_all(devices),
            devices.everything(tiles),
            of_all(seen, devices),
            devices.largest(needed),
        )

    return over(plan.mesh, share, scene, plan, camera)


class _Shaded(eqx.Module):
    """What the tiles show, whatever the weights."""

    post: Float[Array, "tiles pixels #channels"]
    """From radiant exitance to radiance; 0 where no point is."""
    specular: Float[Array, "tiles pixels channels"]


def _in_tiles(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan,
    gather: _diffusion.Gather,
    bounds_of: BoundsOf = _splatting.Bounds.of,
) -> tuple[_diffusion.GatheredLight, _Shaded, SeenSurfaces, Float[Array, ""]]:
    splats, view = scene.splats, _splatting.PerspectiveView.of(camera)
    light = cast_shadows(scene, settings, plan, bounds_of)
    entering = let_light_in(scene, light)
    attributes = settings.lighting.attributes(scene, light, entering)
    seen = see_surfaces(splats, attributes, view, settings, plan).lit(scene, light, settings)
    rest = plan.interval, seen.atlas, plan.diffuser, settings.diffusion.normalization
    variances = scene.material.gaussians.variances
    gathered, needed = gather(
        sources_of(splats, entering.source), variances, seen.receivers(), *rest
    )
    tiles, pixels = seen.covered.shape
    channels = scene.material.gaussians.weights.shape[1]
    unlit = jnp.zeros(
        (tiles, 1, channels, pixels), gathered.means.dtype
    )  # layers are shaded later, when they are weighed
    shaded = shade(
        scene, view, light.groups, seen, _diffusion.DiffusionLayers(unlit, unlit[:, :, 0])
    )
    needed = jnp.max(jnp.stack([needed, seen.needed, light.needed]))
    post = jnp.where(seen.covered[..., None], shaded.post, 0.0)
    return gathered, _Shaded(post, shaded.specular), seen, needed


def _pictured(
    light: _diffusion.GatheredLight, shaded: _Shaded, seen: SeenSurfaces, needed: Float[Array, ""]
) -> GatheredPicture:
    seen = seen.poisoned_unless(needed <= 1)
    tiles, pixels = seen.share.shape
    leaving = seen.atlas.poison * seen.share[..., None] * shaded.post
    return GatheredPicture(
        light=light,
        leaving=leaving.reshape(tiles * pixels, -1).T,
        pixels=seen.atlas.pixels().reshape(-1),
        in_front=jnp.broadcast_to(seen.atlas.in_front[:, None], (tiles, pixels))
        .reshape(-1)
        .astype(leaving.dtype),
        specular=seen.picture(shaded.specular),
        coverage=seen.coverage,
        overflow=jnp.where(needed <= 1, 0.0, needed),
    )
