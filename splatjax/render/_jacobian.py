"""The Jacobian of a picture in its material, pixel by pixel, in about the time of two frames."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax._records import Numbers, as_floats
from splatjax.cache import kept_jit
from splatjax.diffusion import LayersAtPoints
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Camera, Frame, Scene
from splatjax.splatting import PerspectiveView

from ._checks import check_shape
from ._devices import cut_frame, cut_to, on_devices, pad_scene
from ._plan import Plan, check_linear_in_weights, plan_unless_traced
from ._settings import LightAtSplats, RenderSettings
from ._surface import ShadedSurface, SurfaceSamples, compose, layers_at_points

Parameters = TypeVar("Parameters", bound=PyTree)


class PictureJacobian(eqx.Module):
    r"""The derivatives of every pixel of `beauty` with respect to the material's Gaussians.

    **Attributes:**

    - `frame`: the picture itself.
    - `weights`: derivative of channel c with respect to weight `[k, c]`, premultiplied by coverage
      as `beauty` is. A channel does not depend on the weights of other channels.
    - `variances`: derivative of every channel with respect to variance k, radiance per mm^2.
    """

    frame: Frame
    weights: Float[Array, "gaussians height width channels"]
    variances: Float[Array, "gaussians height width channels"]

    def along(self, variances: Numbers, weights: Numbers) -> Float[Array, "height width channels"]:
        """Differentiate `beauty` along a change of variances, [gaussians], and weights, [gaussians,
        channels]; return a derivative picture.

        **Raises:** `ValueError` for a change of other shapes.
        """
        variances, weights = (as_floats(each, self.weights.dtype) for each in (variances, weights))
        gaussians, _, _, channels = self.weights.shape
        check_shape("variances", variances, (gaussians,), "give one for each Gaussian")
        check_shape("weights", weights, (gaussians, channels), "give a row for each Gaussian")
        return jnp.einsum("k,khwc->hwc", variances, self.variances) + jnp.einsum(
            "kc,khwc->hwc", weights, self.weights
        )

    def through(
        self, gaussians_of: Callable[[Parameters], SumOfGaussians], parameters: Parameters
    ) -> Parameters:
        r"""Compute the Jacobian with respect to parameters of the Gaussians, such as coefficients
        and thicknesses.

        **Arguments:**

        - `gaussians_of`: computes the Gaussians of the picture from the parameters, such as
          `fit_gaussians(Dipole(medium)).gaussians`. It is differentiated in forward mode; the
          picture is not rendered again.
        - `parameters`: a record or a tree of arrays, all floating-point.

        **Returns:** a tree like `parameters`; a leaf of shape `s` becomes the derivative of
        `beauty` with respect to this leaf, `[height, width, channels, *s]`.

        **Raises:** `ValueError` when `gaussians_of(parameters)` has other Gaussians than the
        picture.
        """
        shape = self.weights.shape[0], self.weights.shape[3]

        def linear_beauty(parameters):
            made = gaussians_of(parameters)
            check_shape(
                "gaussians_of(parameters).weights",
                made.weights,
                shape,
                "give the function that made the material of the picture",
            )
            return self.along(made.variances, made.weights)

        return jax.jacfwd(linear_beauty)(parameters)


def picture_jacobian(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
) -> PictureJacobian:
    r"""Render, and differentiate every pixel of `beauty` with respect to the weights and variances
    of the material.

        jacobian = picture_jacobian(scene, camera, plan=plan)
        by_coefficient = jacobian.through(lambda m: fit_gaussians(Dipole(m)).gaussians, medium)
        by_coefficient.sigma_a  # [height, width, channels, 3]: d pixel / d absorption

    The derivatives are those of the picture that `render` computes, with its approximations. They
    equal those of reverse mode, pixel by pixel, and take less than two and a half times as long as
    `render`, for any number of pixels or parameters. The Gauss-Newton method for least squares
    needs them; `through` continues them to optical coefficients.

    **Arguments:** as for `render`; under `jit` a plan is needed. With `ClusterDiffuser`, it cannot
    be differentiated again.

    **Returns:** a `PictureJacobian`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render` does, for a material with single scattering unless lighting
    is `LightAtSplats`, and for bounces.
    """
    if scene.material.single_scattering is not None and not isinstance(
        settings.lighting, LightAtSplats
    ):
        raise ValueError(
            f"settings.lighting is {type(settings.lighting).__name__}, and scene.material has "
            "single scattering, which is differentiated only at the splats; give "
            "lighting=LightAtSplats(), or a material without it"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    check_linear_in_weights(settings, plan)
    scene, plan, _, own_rows = pad_scene(scene, plan, None, camera)
    jacobian = own_rows.of(_picture_jacobian(scene, camera, settings, plan), "weights", "variances")
    return dataclasses.replace(jacobian, frame=own_rows.frame(jacobian.frame))


@kept_jit
def _picture_jacobian(
    scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan
) -> PictureJacobian:
    def differentiated(passes, camera):
        scene, plan, material = passes.scene, passes.plan, passes.scene.material
        weighing = material.gaussians, material.single_scattering_albedo()

        def read(shaded: ShadedSurface, at: LayersAtPoints, samples: SurfaceSamples):
            of_weights, of_variances = at.exitance_jacobian(*weighing)
            added = samples.attributes.added_source
            if added is not None:
                # The light that depends on a weight has separate layers.
                layers = samples.layers[:, len(added) :]
                samples = dataclasses.replace(samples, layers=layers, derivative=None)
                gained, _ = layers_at_points(
                    scene,
                    samples,
                    samples.attributes,
                    added,
                    plan.diffusion.gaussians,
                    plan.interval,
                    settings.kernel,
                ).weigh(*weighing)
                weighted = material.gaussians.weights[:, :, None] * gained
                of_weights = of_weights + jnp.sum(weighted, axis=0)[None]
            per_exitance = shaded.radiance_per_exitance[None]
            return shaded, per_exitance * of_weights, per_exitance * of_variances

        (shaded, *derivatives), visible = passes.picture(
            PerspectiveView.padded(camera), lambda at: passes.light(at, derivative=True), read
        )
        pictures = [cut_to(camera, visible.picture(values)) for values in derivatives]
        frame = cut_frame(compose(scene, shaded, visible), camera)
        return PictureJacobian(frame, *(jnp.moveaxis(picture, 2, 0) for picture in pictures))

    return on_devices(differentiated, scene, settings, plan, camera)
