"""A picture for any distant light: rendered once under every spherical harmonic."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.cache import kept_jit
from splatjax.scene import Camera, HarmonicLight, Scene
from splatjax.splatting import Bounds

from ._devices import filled_like, on_devices
from ._passes import Transfer, compute_visibility, light_source, see_and_shade
from ._plan import Plan, plan_unless_traced
from ._render import check_kept, fitted
from ._settings import RenderSettings
from ._shade import compose


class RelightingBasis(eqx.Module):
    r"""A picture for distant light that is still to come.

    **Attributes:**

    - `pictures`: radiance, premultiplied by coverage, under every harmonic of
      `splatjax.scene.spherical_harmonics`.
    - `coverage`: in [0, 1].
    - `overflow`: as in a `Frame`; where it is above 0, pictures are NaN.

    **Source:** Sloan, Kautz and Snyder 2002, "Precomputed Radiance Transfer": here for the pixels
    of one view.
    """

    pictures: Float[Array, "harmonics height width channels"]
    coverage: Float[Array, "height width"]
    overflow: Float[Array, ""]

    @eqx.filter_jit
    def beauty(self, light: HarmonicLight) -> Float[Array, "height width channels"]:
        """Compute the picture that `render` makes under a light: a sum over its harmonics.
        Differentiable in every mode.

        **Arguments:**

        - `light`: of the order of the basis or a lower one, such as `HarmonicLight.of(environment,
          order)`.

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

        # One after the other: a fifteenth of the time of `einsum` on a CPU.
        dark = jnp.zeros_like(self.pictures[0])
        return jax.lax.scan(add, dark, (light.coefficients, self.pictures[:count]))[0]


def relighting_basis(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
    light: Transfer | None = None,
) -> RelightingBasis:
    r"""Render a view under every spherical harmonic: the picture of all smooth environments.

        white = HarmonicLight(np.zeros((25, 3)), count=128)
        basis = relighting_basis(Scene(splats, white, material), camera)
        picture = basis.beauty(HarmonicLight.of(environment))

    It takes about as long as so many pictures with kept shadows, one after the other; then light
    changes at once, and a picture is linear in it. The shadow maps are made once.

    **Arguments:** as for `render`.

    - `scene`: its only light is a `HarmonicLight`, whose coefficients do not matter, but for their
      number.
    - `light`: from `splatjax.transfer` with the same scene, settings and plan.

    **Returns:** a `RelightingBasis`; NaN where the plan does not suffice.

    **Raises:** `ValueError` as `render`, and for other lights.
    """
    kinds = [type(given).__name__ for given in scene.lights]
    if kinds != ["HarmonicLight"]:
        raise ValueError(
            f"scene.lights are {', '.join(kinds) or 'none'}; give one HarmonicLight, and render "
            "other lights by themselves: pictures add up"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    check_kept(light, scene, plan)
    scene, plan, _ = filled_like(scene, plan, camera, light)
    return _relighting_basis(scene, camera, settings, plan, light and fitted(light, scene))


@kept_jit
def _relighting_basis(
    scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan, light: Transfer | None
) -> RelightingBasis:
    def passes(combination, scene, plan, camera, light=None):
        def coefficients(scene):
            return scene.lights[0].coefficients

        bounds = Bounds.of(scene.splats, combination)
        visibility = compute_visibility(scene, settings, plan, combination, bounds, light)
        kept = Transfer(visibility.visibility, visibility.needed)

        def under(light: Float[Array, " harmonics"]):
            gray = jnp.broadcast_to(light[:, None], coefficients(scene).shape)
            lit = eqx.tree_at(coefficients, scene, gray)
            light_at = light_source(lit, settings, plan, combination, kept)
            shaded, visible = see_and_shade(
                lit, camera, settings, plan, combination, light_at, lambda shaded, *_: shaded
            )
            frame = compose(lit, shaded, visible)
            return frame.beauty, frame.coverage, frame.overflow

        # Each harmonic on so much even light that their sum is nowhere negative: where layers of
        # pass 4 do not carry to a pixel, they are limited at zero.
        given = coefficients(scene)
        count = len(given)
        even = np.sqrt(2 * np.floor(np.sqrt(np.arange(count))) + 1) * (np.arange(count) > 0)
        even = jnp.asarray(even, given.dtype)
        lights = jnp.eye(count, dtype=given.dtype).at[:, 0].add(even)
        pictures, coverage, overflow = jax.lax.map(under, lights)
        pictures = pictures - even[:, None, None, None] * pictures[:1]
        return RelightingBasis(pictures, coverage[0], overflow[0])

    return on_devices(passes, scene, plan, camera, placed=light)
