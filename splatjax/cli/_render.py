"""`splatjax render`: from splats and a material to a picture with all its layers."""

import math
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro

import splatjax as sj

from ._outputs import OptionalPath, check_output
from ._report import note, stage

_FILL_SIDE, _FILL_ELEVATION = 25.0, 10.0  # degrees: beside the camera, away from the light
_NARROW = 1e-6  # mm^2: far below any splat, so that the surface's own light stands for the layer


@dataclass(frozen=True, kw_only=True)
class Render:
    """Render splats, or the built-in bust, under a light and a weak fill: an EXR file with every layer, and a PNG file beside it.

    The camera looks at the middle of the splats from far enough to see all of them. Angles are in degrees: azimuth turns
    about the vertical axis, 0 is the front (+z) and 90 the side of +x; elevation rises above the horizon. If the splats carry
    albedo, the weights of the material are divided by their sums, so that color comes from the albedo alone.

    Example: splatjax render head.ply --material skin --azimuth 30 --width 1024 --height 1024 --output head.exr
    """

    splats: tyro.conf.Positional[OptionalPath] = None
    """PLY file of splats, in mm (`splatjax sample` makes one). Without it, the built-in bust."""
    output: Path = Path("out.exr")
    """The EXR file to write; the PNG file has the same name but for its end."""
    material: str = "skin"
    """Name of a material (`splatjax materials`), or path of a TOML file."""
    width: int = 512
    """Width of the picture, pixels."""
    height: int = 512
    """Height of the picture, pixels."""
    azimuth: float = 25.0
    """Of the camera, seen from the middle of the splats."""
    elevation: float = 0.0
    """Of the camera; between -90 and 90, both excluded."""
    fov: float = 25.0
    """Vertical field of view."""
    light_azimuth: float = -20.0
    """Of the place the light comes from; beyond 90 it stands behind."""
    light_elevation: float = 30.0
    """Of the place the light comes from."""
    fill: float = 0.1
    """Of a second light, without shadows, from beside the camera: its share of the first one's strength. 0 for none."""
    exposure: float = 0.0
    """Of the PNG, in stops: each doubles its brightness. The EXR is never changed by it."""
    scattering: bool = True
    """Whether light spreads below the surface. Without, it leaves where it enters, in the same color."""
    count: int = 200_000
    """Number of splats of the built-in bust."""

    def run(self) -> None:
        """Load, render, write."""
        check_output(self.output, (".exr",))
        if not 0 <= self.fill < math.inf:
            raise ValueError(f"--fill is {self.fill:g}; it is a share of the light's strength: 0 or more")
        if not -90 < self.elevation < 90:
            raise ValueError(f"--elevation is {self.elevation:g}; it must lie between -90 and 90 degrees, both excluded")
        material = sj.load_material(self.material)
        splats = self._splats()
        if splats.albedo is not None:
            material = material.white()
            note(f"the splats carry albedo: the weights of {self.material} are divided by their sums")
        material = in_color(material)
        if not self.scattering:
            material = without_scattering(material)
        scene = sj.Scene(splats, self._lights(material.gaussians.weights.shape[1]), material)
        camera = frame_all(splats, towards(self.azimuth, self.elevation), self.fov, self.width, self.height)
        with stage("planning"):
            plan = sj.plan(scene, camera)
        with stage(f"rendering {splats.count} splats at {self.width} x {self.height}"):
            frame = jax.block_until_ready(sj.render(scene, camera, plan=plan))
        if frame.overflow > 0:
            raise ValueError(f"the plan lacks room: {float(frame.overflow):.2f} times what it holds is needed")
        if self.scattering:
            self._say_what_was_handed_over(frame, material)
        picture = self.output.with_suffix(".png")
        with stage(f"writing {self.output} and {picture}"):
            sj.write_exr(self.output, frame, variances=material.gaussians.variances.tolist())
            sj.write_png(picture, frame, exposure=self.exposure)
        print(self.output, picture, sep="\n")

    def _lights(self, channels: int) -> tuple[sj.DirectionalLight, ...]:
        # On a white diffuser that faces it, the first light gives radiance 1.
        irradiance = jnp.full(channels, jnp.pi)
        key = sj.DirectionalLight(direction=-towards(self.light_azimuth, self.light_elevation), irradiance=irradiance)
        if self.fill == 0:
            return (key,)
        side = math.copysign(_FILL_SIDE, self.azimuth - self.light_azimuth)
        beside = towards(self.azimuth + side, _FILL_ELEVATION)
        return key, sj.DirectionalLight(direction=-beside, irradiance=self.fill * irradiance, cast_shadows=False)

    def _splats(self) -> sj.Splats:
        if self.splats is None:
            with stage(f"making the bust with {self.count} splats"):
                return sj.bust(self.count)
        with stage(f"reading {self.splats}"):
            return sj.read_splats(self.splats)

    def _say_what_was_handed_over(self, frame: sj.Frame, material: sj.Material) -> None:
        handed_over = frame.handed_over > 0.5
        widths = ", ".join(
            f"{float(v) ** 0.5:.3g}" for v, there in zip(material.gaussians.variances, handed_over, strict=True) if there
        )
        if widths:
            note(f"narrower than the splats, so that the surface's own light stands for them: the Gaussians of {widths} mm")


def in_color(material: sj.Material) -> sj.Material:
    """Give a material of one channel the same weights for red, green and blue."""
    gaussians = material.gaussians
    if gaussians.weights.shape[1] != 1:
        return material
    weights = jnp.broadcast_to(gaussians.weights, (len(gaussians.variances), 3))
    single = material.single_scattering
    if single is not None:
        single = jax.tree.map(lambda values: jnp.broadcast_to(values, 3), single)
    gaussians = sj.SumOfGaussians(gaussians.variances, weights)
    return sj.Material(gaussians, material.eta, material.specular, material.roughness, single)


def without_scattering(material: sj.Material) -> sj.Material:
    """Give the same surface and color with light that leaves where it enters: one Gaussian, narrower than any splat."""
    gaussians = material.gaussians
    variances = jnp.full_like(gaussians.variances, _NARROW, shape=(1,))
    return material.surface_of(sj.SumOfGaussians(variances, material.total_reflectance()[None]))


def towards(azimuth: float, elevation: float) -> jax.Array:
    """Give the unit vector from the middle towards a place on the sky, given in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    across = math.cos(elevation)
    return jnp.asarray([math.sin(azimuth) * across, math.sin(elevation), math.cos(azimuth) * across], float)


def frame_all(splats: sj.Splats, direction: jax.Array, fov: float, width: int, height: int) -> sj.Camera:
    """Place a camera in a direction so that the bounding sphere of the splats just fits the narrower side of the picture."""
    low, high = jnp.min(splats.centers, axis=0), jnp.max(splats.centers, axis=0)
    middle = (low + high) / 2
    radius = float(jnp.max(jnp.linalg.norm(splats.centers - middle[None], axis=1) + splats.radii))
    if not 0 < fov < 180 or width < 1 or height < 1:
        distance = 1.0  # `look_at` refuses, and says why
    else:
        half_angle = math.atan(math.tan(math.radians(fov) / 2) * min(1.0, width / height))
        distance = radius / math.sin(half_angle)
    eye = middle + distance * direction.astype(middle.dtype)
    return sj.Camera.look_at(eye, middle, fov=fov, width=width, height=height)
