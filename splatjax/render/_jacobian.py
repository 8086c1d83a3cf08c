"""The Jacobian of a picture in its material, pixel by pixel, at the price of about one more
pass 4.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.devices import Devices
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Camera, Frame, Scene

from ._inputs import check_channels, in_one_dtype
from ._lighting import EnteringLight, LightAtSplats, LightOnSplats, let_light_in
from ._passes import (
    BoundsOf,
    SeenSurfaces,
    ShadedSurface,
    bounds_over,
    cast_shadows,
    compose,
    see_surfaces,
    shade,
    sources_of,
)
from ._plan import plan_unless_traced
from ._records import Plan
from ._settings import RenderSettings
from ._sharded import of_all, over

Parameters = TypeVar("Parameters", bound=PyTree)


class PictureJacobian(eqx.Module):
    r"""What every pixel of `beauty` does per change of the material's Gaussians.

    **Attributes:**

    - `frame`: the picture at which it was taken.
    - `weights`: derivative of channel c in weight `[k, c]`, premultiplied by coverage as `beauty`
      is. The weights of other channels do not matter to a channel.
    - `variances`: derivative of every channel in variance k, radiance per mm^2.
    """

    frame: Frame
    weights: Float[Array, "gaussians height width channels"]
    variances: Float[Array, "gaussians height width channels"]

    def along(self, change: SumOfGaussians) -> Float[Array, "height width channels"]:
        """Give what `beauty` does along a change of weights and variances: a derivative picture."""
        moved = jnp.tensordot(change.variances, self.variances, 1)
        return moved + jnp.sum(change.weights[:, None, None] * self.weights, axis=0)

    def through(
        self, gaussians_of: Callable[[Parameters], SumOfGaussians], parameters: Parameters
    ) -> Parameters:
        r"""Give the Jacobian in what the Gaussians were made of: coefficients, thicknesses,
        anything.

        **Arguments:**

        - `gaussians_of`: from parameters to the Gaussians of the picture, such as
          `fit_gaussians(Dipole(medium)).gaussians`. It is differentiated in forward mode; the
          picture is not rendered again.
        - `parameters`: a record or a tree of arrays, all floating-point.

        **Returns:** a tree like `parameters`; a leaf of shape `s` becomes the derivative of
        `beauty` in it, `[height, width, channels, *s]`.

        **Raises:** `ValueError` when `gaussians_of(parameters)` has other Gaussians than the
        picture.
        """
        dtype = self.weights.dtype
        made = gaussians_of(parameters)
        shape = self.weights.shape[0], self.weights.shape[3]
        if made.weights.shape != shape:
            raise ValueError(
                f"gaussians_of(parameters) has {list(made.weights.shape)} Gaussians and channels, "
                "the picture was made with "
                f"{list(shape)}: give the function that made the picture's material"
            )
        slopes = jax.jacfwd(gaussians_of)(parameters)
        leaves, structure = jax.tree.flatten(parameters)
        of_variances = structure.flatten_up_to(slopes.variances)
        of_weights = structure.flatten_up_to(slopes.weights)

        def chain(of_variances, of_weights, leaf):
            of_variances = of_variances.reshape(shape[0], -1).astype(dtype)
            of_weights = of_weights.reshape(*shape, -1).astype(dtype)
            found = jnp.einsum("khwc,kp->hwcp", self.variances, of_variances)
            found = found + jnp.einsum("khwc,kcp->hwcp", self.weights, of_weights)
            return found.reshape(*found.shape[:3], *jnp.shape(leaf))

        return structure.unflatten(
            [chain(v, w, leaf) for v, w, leaf in zip(of_variances, of_weights, leaves, strict=True)]
        )


def picture_jacobian(
    scene: Scene, camera: Camera, settings: RenderSettings | None = None, plan: Plan | None = None
) -> PictureJacobian:
    r"""Render, and differentiate every pixel of `beauty` in the weights and variances of the
    material.

    The derivative of the very picture that `render` makes, approximations included, as reverse mode
    gives it one pixel at a time. It costs about one more pass 4: less than two and a half frames,
    whatever the number of pixels or parameters. With a least squares solver this is the Jacobian of
    Gauss and Newton; from it `through` gives those in optical coefficients.

    **Arguments:** as for `render`; under `jit` a plan is needed. Not itself differentiable where
    the diffuser is fast.

    **Returns:** a `PictureJacobian`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render`, and for a material with single scattering under light that
    is not found at the splats.
    """
    settings = RenderSettings() if settings is None else settings
    check_channels(scene)
    if scene.material.single_scattering is not None and not isinstance(
        settings.lighting, LightAtSplats
    ):
        raise ValueError(
            f"settings.lighting is {type(settings.lighting).__name__}, and scene.material has "
            "single scattering, whose share of "
            "the light is differentiated at the splats alone; give lighting=LightAtSplats(), or a "
            "material without it"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    return _picture_jacobian(scene, camera, settings, plan)


@eqx.filter_jit
def _picture_jacobian(
    scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan
) -> PictureJacobian:
    scene, camera = in_one_dtype(scene, camera)
    if plan.mesh is None:
        return _pictured(scene, *_in_tiles(scene, camera, settings, plan))

    def share(devices: Devices, scene: Scene, plan: Plan, camera: Camera) -> PictureJacobian:
        tiles, seen, needed = _in_tiles(scene, camera, settings, plan, bounds_over(devices))
        return _pictured(
            scene, devices.everything(tiles), of_all(seen, devices), devices.largest(needed)
        )

    return over(plan.mesh, share, scene, plan, camera)


class _Differentiated(eqx.Module):
    """What the tiles show, and how radiant exitance changes there."""

    shaded: ShadedSurface
    resolved: Float[Array, "tiles gaussians pixels"]
    weights: Float[Array, "tiles gaussians channels pixels"]
    variances: Float[Array, "tiles gaussians channels pixels"]


def _pictured(
    scene: Scene, tiles: _Differentiated, seen: SeenSurfaces, needed: Float[Array, ""]
) -> PictureJacobian:
    seen = seen.poisoned_unless(needed <= 1)

    def of_beauty(slopes: Float[Array, "tiles gaussians channels pixels"]):
        return seen.picture(tiles.shaded.post[:, None] * slopes.transpose(0, 1, 3, 2))

    frame = compose(tiles.shaded, seen, tiles.resolved, scene.material.gaussians.weights, needed)
    return PictureJacobian(frame, of_beauty(tiles.weights), of_beauty(tiles.variances))


def _in_tiles(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan,
    bounds_of: BoundsOf = _splatting.Bounds.of,
) -> tuple[_Differentiated, SeenSurfaces, Float[Array, ""]]:
    splats, material = scene.splats, scene.material
    view = _splatting.PerspectiveView.of(camera)
    light = cast_shadows(scene, settings, plan, bounds_of)
    entering, more = _entering_and_its_slope(scene, light)
    attributes = settings.lighting.attributes(scene, light, entering)
    if more is not None:
        attributes["more"] = more
    seen = see_surfaces(splats, attributes, view, settings, plan).lit(scene, light, settings)
    rest = plan.interval, seen.atlas, plan.diffuser, settings.diffusion.normalization
    layers, slopes, needed = _diffusion.exitance_jacobian(
        sources_of(splats, entering.source), material, seen.receivers(), *rest
    )
    of_weights = slopes.weights
    if more is not None:
        gained, _ = _diffusion.diffusion_layers(
            sources_of(splats, more), material, seen.receivers("more"), *rest
        )
        of_weights = of_weights + jnp.sum(
            material.gaussians.weights[None, :, :, None] * gained.layers, axis=1, keepdims=True
        )
    shaded = shade(scene, view, light.groups, seen, layers)
    needed = jnp.max(jnp.stack([needed, seen.needed, light.needed]))
    return _Differentiated(shaded, layers.resolved, of_weights, slopes.variances), seen, needed


def _entering_and_its_slope(
    scene: Scene, light: LightOnSplats
) -> tuple[EnteringLight, Float[Array, "channels splats"] | None]:
    """Also give what each weight adds to the light that spreads: beside single scattering, which
    leaves less where it grazes.
    """
    if scene.material.single_scattering is None:
        return let_light_in(scene, light), None
    weights = scene.material.gaussians.weights

    def entering(more: Float[Array, " channels"]):
        return let_light_in(
            eqx.tree_at(lambda s: s.material.gaussians.weights, scene, weights.at[0].add(more)),
            light,
        )

    found, slope = jax.jvp(entering, (jnp.zeros_like(weights[0]),), (jnp.ones_like(weights[0]),))
    return found, slope.source
