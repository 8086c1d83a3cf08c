"""A scene that keeps intermediate results until their inputs change."""

from collections.abc import Hashable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from splatjax import fitting as _fitting
from splatjax._chunking import rounded_up
from splatjax._display import to_display
from splatjax._records import Numbers
from splatjax.gaussians import SumOfGaussians
from splatjax.io import picture_to_rgb, spectrum_to_rgb
from splatjax.render import (
    DiffusionBasis,
    Plan,
    RenderSettings,
    SplatLight,
    diffusion_basis,
    illuminate,
    make_plan,
    render,
    transfer,
)
from splatjax.scattering import Medium, Skin
from splatjax.scene import Camera, EnvironmentLight, Frame, Scene, even_directions

from ._body import Body
from ._controls import (
    COEFFICIENTS,
    LAYERS,
    PIGMENTS,
    Controls,
    brightened,
    plain,
    rotation_about_y,
    turned,
)
from ._programs import (
    Optics,
    blend,
    changes_with_coefficients,
    light_of_gaussians,
    profile_curves,
    variances_and_angles,
    weights_of,
)

_DIRECTIONS = 64  # shadow directions of a rotating environment
_MERGED = 6  # splats of the body per splat of a draft
_WIDER = 1.25  # additional factor of the radii in a draft, to close holes between splats
_PLANNED = 1.2  # factor by which variances may change before a new plan is made
# Planned cameras: degrees around the target, and distances relative to that of the first camera.
_QUARTERS = (0.0, 90.0, 180.0, 270.0)
_DISTANCES = (1.0, 0.5)
# The shares of diffuse and of specular light in a layer.
_SHARES = {"beauty": (1.0, 1.0), "diffuse": (1.0, 0.0), "specular": (0.0, 1.0)}


class Session:
    r"""A scene under changing controls.

    A session keeps the most recent result of each kind: the visibility of the lights, the light on
    the splats, and the layers of the view (`splatjax.DiffusionBasis`). While coefficients change,
    the variances of the Gaussians are fixed, only their weights are fitted, and the kept layers are
    blended. If no layers are kept for a state, `draft` renders a sixth of the splats at half the
    width and height. Drafts use the default settings.

    **Arguments:**

    - `scene`: its material has no single scattering. If the splats have an albedo, it alone
      determines the color. Drafts use 64 directions of an environment without `directions`.
    - `camera`: camera of the first picture. From other places it is upright.
    - `target`: the point that the camera looks at, mm.
    - `settings`: settings of full pictures, such as bounces.
    - `exposure`: exposure of the first picture, stops.
    - `skin`: the skin to which the material was fitted; its pigments change instead of
      coefficients.
    - `g`: mean cosine of the phase function of the material's medium.

    **Attributes:**

    - `start`: the `Controls` of the first picture.

    **Raises:** `ValueError` for a material with single scattering.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        target: Numbers,
        settings: RenderSettings = RenderSettings(),
        *,
        exposure: float = 0.0,
        skin: Skin | None = None,
        g: float = 0.0,
    ):
        material = scene.material
        if material.single_scattering is not None:
            raise ValueError(
                "the material has single scattering, so less light enters as the weights "
                "grow; fit it without --single-scattering"
            )
        self.start = Controls.of(scene, camera, target, exposure, skin, g)
        self.own, self.skin, self.settings, self._own_camera = scene, skin, settings, camera
        self.fov = float(np.degrees(2 * np.arctan(0.5 / camera.focal_length)))
        few = jax.tree.map(lambda leaf: leaf[::_MERGED], scene.splats)
        radii, areas = _WIDER * _MERGED**0.5 * few.radii, _MERGED * few.areas
        few = replace(few, radii=radii, areas=areas)
        even = tuple(
            replace(light, directions=even_directions(_DIRECTIONS))
            if isinstance(light, EnvironmentLight) and light.directions is None
            else light
            for light in scene.lights
        )
        self._coarse = Body(few, even, -(-camera.width // 2), -(-camera.height // 2))
        full = scene.splats, tuple(scene.lights), camera.width, camera.height
        self._still = Body(*full, settings)
        self._full = self._still if self._still.is_blended else Body(*full)
        self._variances = self._planned = material.gaussians.variances
        self._angles, self._settled = material.angles, self.start.coefficients

    def picture(self, controls: Controls) -> UInt8[np.ndarray, "height width 3"]:
        """Fit variances and angles to the coefficients, and compute the picture that
        `splatjax.render` makes of `scene(controls)`, encoded for a display.
        """
        self._settle(controls)
        self._basis(self._full, controls)  # for later drafts
        return self._show(self._still, controls)

    def draft(self, controls: Controls) -> UInt8[np.ndarray, "height width 3"]:
        """Compute a picture from kept layers, with the variances and angles of the last `picture`,
        or else at low resolution.
        """
        is_kept = self._full.has("basis", self._keys(controls, self._full))
        return self._show(self._full if is_kept else self._coarse, controls)

    def frame(self, controls: Controls, body: Body | None = None) -> Frame:
        """Render the scene with all its layers."""
        body = body or self._still
        return body.planned(
            lambda: render(
                self.scene(controls, body),
                self.camera(controls, body),
                body.settings,
                self._plan(body, controls),
                light=self._light(body, controls),
            )
        )

    def pixel(
        self, controls: Controls, column: int, row: int
    ) -> dict[str, Float[np.ndarray, " channels"]]:
        """Decompose the radiance of a pixel.

        **Returns:** for each channel, the radiance, the highlight, and the contribution of each
        Gaussian, labeled by its width. If there are coefficients, also the derivatives of the
        radiance with respect to the logarithms of absorption and scattering, or of melanin and
        blood, at fixed variances.
        """
        basis, gaussians = self._basis(self._full, controls), self._gaussians(controls)
        place, optics = (row, column), self.optics(controls)
        light = light_of_gaussians(basis, gaussians, place)
        highlight = controls.specular * basis.specular[place]
        parts = {"radiance": jnp.sum(light, axis=0) + highlight, "highlight": highlight}
        widths = np.sqrt(gaussians.variances).tolist()
        parts |= {f"{width:.2g} mm": of for width, of in zip(widths, light, strict=True)}
        if optics is not None:
            names = tuple(COEFFICIENTS) if isinstance(optics, Medium) else PIGMENTS[:2]
            inputs = self.model(controls), optics, names, self._variances, self._has_color
            changes = zip(names, changes_with_coefficients(*inputs, basis, place), strict=True)
            parts |= {f"per ln {COEFFICIENTS.get(n, n)}": controls.scale * of for n, of in changes}
        return {name: np.asarray(values, np.float64) for name, values in parts.items()}

    def scene(self, controls: Controls, body: Body | None = None) -> Scene:
        """Return the scene of a state; after `picture`, the scene of that picture. Its material has
        no medium if the weights were changed manually.
        """
        optics, body = self.optics(controls), body or self._full
        has_medium = isinstance(optics, Medium) and controls.has_fitted_weights
        material = replace(
            self.own.material,
            gaussians=self._gaussians(controls),
            angles=self._angles,
            medium=optics if has_medium else None,
            eta=controls.eta,
            specular=controls.specular,
            roughness=controls.roughness,
        )
        lights = brightened(turned(body.lights, controls.turn), controls.light_stops)
        return Scene(body.splats, lights, material)

    def camera(self, controls: Controls, body: Body | None = None) -> Camera:
        """Return the camera of a state."""
        own = replace(self._own_camera, **(body or self._full).size)
        return controls.camera(own, self.start)

    def curves(self, controls: Controls) -> list[np.ndarray]:
        """Compute the curves of a plot of the profile and its fit.

        **Returns:** radii (mm); for each channel, if there are coefficients, the profile times the
        radius (1/mm); and for each channel the sum of Gaussians times the radius.
        """
        widest = 3 * np.sqrt(np.max(self.own.material.gaussians.variances))
        radii = jnp.asarray(np.geomspace(0.01 * widest, widest, 120), self._variances.dtype)
        inputs = self.model(controls), self.optics(controls), self._fitted(controls), radii
        return [np.asarray(row, np.float64) for row in (radii, *profile_curves(*inputs))]

    def model(self, controls: Controls) -> _fitting.AbstractModel:
        """Return the model that fits Gaussians to the coefficients or pigments of a state."""
        if self.skin is None:
            return _fitting.TransportModel(jnp.asarray(controls.g, self._variances.dtype))
        is_rgb, nodes = self.own.material.wavelengths is None, self.skin.wavelengths
        return _fitting.SkinModel(spectrum_to_rgb(nodes) if is_rgb else np.eye(len(nodes)))

    def optics(self, controls: Controls) -> Optics | None:
        """Return the medium or the skin of a state, if it has one."""
        own = self.own.material.medium if self.skin is None else self.skin
        if own is None or controls.coefficients == self.start.coefficients:
            return own
        if self.skin is not None:
            return replace(self.skin, eta=controls.eta, **dict(controls.skin))
        rows = controls.sigma_a, controls.sigma_s_prime, [controls.eta] * len(controls.sigma_a)
        return Medium(*(jnp.asarray(row, self._variances.dtype) for row in rows))

    def _fitted(self, controls: Controls) -> SumOfGaussians:
        """Return the Gaussians of the material, or Gaussians fitted to changed coefficients."""
        gaussians, optics = self.own.material.gaussians, self.optics(controls)
        is_own = optics is self.optics(self.start) and self._variances is gaussians.variances
        if optics is None or is_own:
            return gaussians
        key, inputs = controls.coefficients, (self.model(controls), optics, self._variances)
        return self._full.keep("fit", (key, self._settled), lambda: weights_of(*inputs))

    def _gaussians(self, controls: Controls) -> SumOfGaussians:
        """Return the Gaussians of a state, whose factors do not change the color of an albedo."""
        gaussians = self._fitted(controls)
        factors = jnp.asarray(controls.factors, gaussians.weights.dtype)[:, None]
        gaussians = SumOfGaussians(gaussians.variances, gaussians.weights * factors)
        gaussians = gaussians if self._has_color else gaussians.white()
        return SumOfGaussians(gaussians.variances, gaussians.weights * controls.scale)

    @property
    def _has_color(self) -> bool:
        return self.own.splats.albedo is None

    def _settle(self, controls: Controls) -> None:
        """Fit variances and angles to the coefficients."""
        if controls.coefficients == self._settled:
            return
        material, optics = self.own.material, self.optics(controls)
        self._variances, self._angles = material.gaussians.variances, material.angles
        if optics is not None and optics is not self.optics(self.start):
            self._variances, angles = variances_and_angles(
                self.model(controls), optics, self._variances
            )
            self._angles = angles if self._has_color else None
        self._settled = controls.coefficients
        if np.max(np.abs(np.log(self._variances / self._planned))) > np.log(_PLANNED):
            self._planned = self._variances

    def _keys(self, controls: Controls, body: Body) -> tuple[Hashable, Hashable]:
        """Return the keys of the light on the splats and of the view."""
        state: Hashable = replace(controls, eye=(), target=(), layer=LAYERS[0], exposure=0.0)
        if body.is_blended:
            state = controls.turn, controls.light_stops, controls.eta, controls.roughness
        return (state, self._settled), (controls.eye, controls.target)

    def _plan(self, body: Body, controls: Controls) -> Plan:
        """Make a plan for cameras and lights from all sides."""

        def make() -> Plan:
            start, scene = self.start, self.scene(controls, body)
            offset = np.subtract(start.eye, start.target)
            offsets = [d * rotation_about_y(t) @ offset for t in _QUARTERS for d in _DISTANCES]
            eyes = [plain(np.add(start.target, offset)) for offset in offsets]
            states = [controls, *(replace(start, eye=eye) for eye in eyes)]
            turns = [0.0] if body.is_in_environments else _QUARTERS
            return make_plan(
                [replace(scene, lights=turned(scene.lights, turn)) for turn in turns],
                [self.camera(state, body) for state in states],
                body.settings,
            )

        return body.keep("plan", plain(self._planned), make)

    def _light(self, body: Body, controls: Controls) -> SplatLight:
        turn = None if body.keeps_shadows else controls.turn

        def make() -> SplatLight:
            inputs = self.scene(controls, body), self._plan(body, controls), body.settings
            visible = body.keep("visibility", (turn,), lambda: transfer(*inputs))
            return illuminate(*inputs, light=visible)

        return body.keep("light", self._keys(controls, body)[0], make)

    def _basis(self, body: Body, controls: Controls) -> DiffusionBasis:
        def make() -> DiffusionBasis:
            shiny = replace(controls, specular=1.0)
            basis = diffusion_basis(
                self.scene(shiny, body),
                self.camera(shiny, body),
                plan=self._plan(body, controls),
                light=self._light(body, controls),
            )
            # Keep only the visible points, fewer than half, so that sliders respond faster.
            is_seen = np.any(np.asarray(basis.pixel_radiance_per_exitance) != 0, axis=0)
            count = rounded_up(int(is_seen.sum()), 1, per_octave=2)
            return basis.of_points(np.argsort(~is_seen, kind="stable")[:count])

        return body.keep("basis", self._keys(controls, body), lambda: body.planned(make))

    def _show(self, body: Body, controls: Controls) -> UInt8[np.ndarray, "height width 3"]:
        if body.is_blended and controls.layer in _SHARES:
            basis, (diffuse, specular) = self._basis(body, controls), _SHARES[controls.layer]
            shares = jnp.asarray([diffuse, specular * controls.specular], basis.specular.dtype)
            values = blend(basis, self._gaussians(controls), shares)
        else:
            keys = self._keys(controls, body)
            frame = body.keep("frame", keys, lambda: self.frame(controls, body))
            shadow = jnp.broadcast_to(jnp.mean(frame.shadow, 0)[..., None], frame.beauty.shape)
            shown = {"shadow": shadow, "irradiance": frame.irradiance / jnp.pi}
            values = shown.get(controls.layer, getattr(frame, controls.layer))
        rgb = picture_to_rgb(np.asarray(values), self.own.material.wavelengths)
        image = to_display(rgb, controls.exposure)
        return np.broadcast_to(image, (*image.shape[:2], 3))
