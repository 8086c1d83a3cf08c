"""Pictures for any weights or any distant light, by rendering once the part that is independent of
them.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax._precision import full_precision
from splatjax.cache import kept_jit
from splatjax.diffusion import LayersAtPoints
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Camera, HarmonicLight, Scene
from splatjax.splatting import PerspectiveView, invalid_factor

from ._checks import check_shape
from ._devices import cut_to, on_devices, pad_scene
from ._lighting import Transfer
from ._passes import SplatLight
from ._plan import Plan, check_linear_in_weights, plan_unless_traced
from ._render import render, transfer
from ._settings import RenderSettings
from ._surface import ShadedSurface, in_a_row


class DiffusionBasis(eqx.Module):
    r"""A picture as a function of the weights.

    The points are the visible points of the front surface and of the surface behind it at
    silhouettes.

    **Attributes:**

    - `light`: the layers at every point.
    - `pixel_radiance_per_exitance`: radiance towards the eye per radiant exitance, times the
      point's fraction of the pixel; 0 without a point.
    - `pixels`: the index of the pixel of each point, row by row.
    - `in_front`: 1 for a point of the surface in front, else 0.
    - `specular`: radiance, premultiplied.
    - `coverage`: in [0, 1].
    - `overflow`: as in a `Frame`; where it is above 0, pictures are NaN.
    """

    light: LayersAtPoints
    pixel_radiance_per_exitance: Float[Array, "#channels points"]
    pixels: Int[Array, " points"]
    in_front: Float[Array, " points"]
    specular: Float[Array, "height width channels"]
    coverage: Float[Array, "height width"]
    overflow: Float[Array, ""]

    def beauty(self, gaussians: SumOfGaussians) -> Float[Array, "height width channels"]:
        """Compute the picture that `render` makes of these Gaussians. Differentiable in every mode.

        **Arguments:**

        - `gaussians`: the variances are assumed to be those that were rendered; with the derivative
          they may differ a little, to first order.

        **Raises:** `ValueError` for another number of Gaussians or channels.
        """
        shape = len(self.light.variances), self.specular.shape[2]
        remedy = "give as many Gaussians and channels as the basis was rendered with"
        check_shape("gaussians.weights", gaussians.weights, shape, remedy)
        radiance = self.pixel_radiance_per_exitance * self.light.exitance(gaussians)
        height, width, channels = self.specular.shape
        diffuse = jnp.zeros((channels, height * width), radiance.dtype)
        diffuse = diffuse.at[:, self.pixels].add(radiance)
        return diffuse.T.reshape(height, width, channels) + self.specular

    def of_points(self, chosen: Int[np.ndarray, " chosen"]) -> "DiffusionBasis":
        """Select some of the points. Most points of a new basis are in no pixel."""
        return eqx.tree_at(
            lambda basis: (
                *jax.tree.leaves([getattr(basis.light, name) for name in basis.light.ALONG_POINTS]),
                *(basis.pixel_radiance_per_exitance, basis.in_front, basis.pixels),
            ),
            self,
            replace_fn=lambda leaf: leaf[..., chosen],
        )


def diffusion_basis(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
    derivative: bool = False,
    light: SplatLight | Transfer | None = None,
) -> DiffusionBasis:
    r"""Render the part of a picture that does not depend on the weights of the material.

    It costs about as much as the picture. The pictures of many materials of the same variances, and
    their derivatives, are then cheap.

    **Arguments:** as for `render`; the weights of `scene.material` do not matter.

    - `derivative`: also differentiate the layers with respect to their variances, for about one
      more pass 4. The picture then has the derivatives of `picture_jacobian`, with respect to
      weights, variances and their parameters.
    - `light`: as for `render`; from `splatjax.illuminate` with the same `derivative`.

    **Returns:** a `DiffusionBasis`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render` does, and for single scattering and bounces, with which the
    light that enters depends on the weights.
    """
    if scene.material.single_scattering is not None:
        raise ValueError(
            "scene.material has single scattering, with which the light that enters depends "
            "on the weights; render each material separately, or give single_scattering=None"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    check_linear_in_weights(settings, plan)
    if derivative and isinstance(light, SplatLight) and light.derivative is None:
        raise ValueError("light has no derivative; compute it by illuminate(..., derivative=True)")
    scene, plan, light, own_rows = pad_scene(scene, plan, light, camera)
    basis = _diffusion_basis(scene, camera, settings, plan, derivative, light)
    names = "variances", "means", "mass", "derivative", "factors"
    return dataclasses.replace(basis, light=own_rows.of(basis.light, *names))


@kept_jit
def _diffusion_basis(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan,
    derivative: bool,
    light: SplatLight | Transfer | None,
) -> DiffusionBasis:
    def basis(passes, camera, light=None):
        def read(shaded: ShadedSurface, at: LayersAtPoints, _):
            return (
                {name: getattr(at, name) for name in at.ALONG_POINTS},
                shaded.radiance_per_exitance,
                shaded.specular,
            )

        (*rows, specular), visible = passes.picture(
            PerspectiveView.padded(camera),
            lambda at: passes.light(at, kept=light, derivative=derivative),
            read,
        )
        layers, per_exitance = jax.tree.map(in_a_row, rows)
        x, y = visible.grid.columns_and_rows(visible.tiles)
        shown = (x < camera.width) & (y < camera.height)
        share = jnp.where(shown, visible.share, 0)
        x, y = jnp.minimum(x, camera.width - 1), jnp.minimum(y, camera.height - 1)
        return DiffusionBasis(
            light=LayersAtPoints(
                variances=passes.scene.material.gaussians.variances,
                interval=passes.plan.interval,
                kernel=settings.kernel,
                **layers,
            ),
            pixel_radiance_per_exitance=(
                invalid_factor(visible.needed) * share.reshape(1, -1) * per_exitance
            ),
            pixels=(y * camera.width + x).reshape(-1),
            in_front=jnp.repeat(visible.in_front, x.shape[1]).astype(per_exitance.dtype),
            specular=cut_to(camera, visible.picture(specular)),
            coverage=cut_to(camera, visible.picture(jnp.ones_like(specular[:, 0]))),
            overflow=visible.overflow,
        )

    return on_devices(basis, scene, settings, plan, camera, placed=light)


class RelightingBasis(eqx.Module):
    r"""A picture as a function of distant light.

    **Attributes:**

    - `pictures`: radiance, premultiplied by coverage, under every harmonic of
      `splatjax.scene.spherical_harmonics`.
    - `coverage`: in [0, 1].
    - `overflow`: as in a `Frame`; where it is above 0, pictures are NaN.

    **Source:** Sloan, Kautz and Snyder 2002, "Precomputed Radiance Transfer": applied to the pixels
    of one view.
    """

    pictures: Float[Array, "harmonics height width channels"]
    coverage: Float[Array, "height width"]
    overflow: Float[Array, ""]

    @full_precision
    @eqx.filter_jit
    def beauty(self, light: HarmonicLight) -> Float[Array, "height width channels"]:
        """Compute the picture that `render` makes under a light whose radiance is positive: a sum
        over its harmonics. Where light is negative, `render` limits it to 0, and this picture does
        not. Differentiable in every mode.

        **Arguments:**

        - `light`: a light of the order of the basis or of a lower order, such as
          `HarmonicLight.of(environment, order)`.

        **Raises:** `ValueError` for a light of a higher order.
        """
        count, harmonics = len(light.coefficients), len(self.pictures)
        if count > harmonics:
            raise ValueError(
                f"light has {count} harmonics, and the basis was rendered for {harmonics}; give a "
                "light of a lower order, or render a basis of a higher one"
            )

        def add(picture, harmonic):
            coefficients, under = harmonic
            return picture + coefficients[None, None] * under, None

        # A loop takes a fifteenth of the time of `einsum` on a CPU.
        dark = jnp.zeros_like(self.pictures[0])
        return jax.lax.scan(add, dark, (light.coefficients, self.pictures[:count]))[0]


def relighting_basis(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
    light: Transfer | None = None,
) -> RelightingBasis:
    r"""Render a view under every spherical harmonic, for pictures under all smooth environments.

        white = HarmonicLight(np.zeros((25, 3)), count=128)
        basis = relighting_basis(Scene(splats, white, material), camera)
        picture = basis.beauty(HarmonicLight.of(environment))

    It takes about as long as one picture per harmonic without shadow maps, which are rendered once.
    Pictures under other light are then cheap, and linear in the light.

    **Arguments:** as for `render`.

    - `scene`: has one light, a `HarmonicLight`; only its number of coefficients matters.
    - `light`: from `splatjax.transfer` with the same scene, settings and plan.

    **Returns:** a `RelightingBasis`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render` does, and for other lights.
    """
    kinds = [kind.__name__ for kind in map(type, scene.lights)]
    if kinds != ["HarmonicLight"]:
        raise ValueError(
            f"scene.lights are {', '.join(kinds) or 'none'}; give one HarmonicLight, and "
            "render other lights separately, since pictures add up"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    scene, plan, light, _ = pad_scene(scene, plan, light, camera)
    return _relighting_basis(scene, camera, settings, plan, light)


@kept_jit
def _relighting_basis(
    scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan, light: Transfer | None
) -> RelightingBasis:
    def coefficients(scene):
        return scene.lights[0].coefficients

    template = coefficients(scene)
    kept = transfer(scene, plan, settings) if light is None else light

    def under(harmonics: Float[Array, " harmonics"]):
        lit = eqx.tree_at(coefficients, scene, jnp.broadcast_to(harmonics[:, None], template.shape))
        frame = render(lit, camera, settings, plan, light=kept)
        return frame.beauty, frame.coverage, frame.overflow

    # Add uniform light to each harmonic so that the sum is nowhere negative: layers of pass 4 are
    # limited at zero where they do not reach a pixel.
    count = len(template)
    even = np.sqrt(2 * np.floor(np.sqrt(np.arange(count))) + 1) * (np.arange(count) > 0)
    even = jnp.asarray(even, template.dtype)
    lights = jnp.eye(count, dtype=template.dtype).at[:, 0].add(even)
    pictures, coverage, overflow = jax.lax.map(under, lights)
    pictures = pictures - even[:, None, None, None] * pictures[:1]
    return RelightingBasis(pictures, coverage[0], overflow[0])
