"""What `splatjax render` and `splatjax turntable` share: what is shown, from where, and under which
light.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

import splatjax as sj
from splatjax.io import check_memory, fingerprint, free_bytes, material_path, own_version
from splatjax.scene import Parts

from ._options import MaterialName, UpAxis
from ._report import note, stage

_FILL_SIDE, _FILL_ELEVATION = 25.0, 10.0  # degrees: beside the camera, away from the light
_BYTES_PER_SPLAT, _BYTES_PER_PIXEL = (
    1000.0,
    500.0,
)  # at least: what does not fit by these does not fit


@dataclass(frozen=True, kw_only=True)
class Shot:
    """Splats of one material, a camera that sees all of them, a light and a weak fill."""

    #: PLY file of splats, in mm (`splatjax sample` makes one). Without it, the built-in bust.
    splats: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[SPLATS]", help_behavior_hint="")
    ] = None
    #: What is written.
    output: Path
    #: Name of a material (`splatjax materials`), or path of a TOML file.
    material: MaterialName = "skin"
    #: Width of the picture, pixels.
    width: int = 512
    #: Height of the picture, pixels.
    height: int = 512
    #: Of the camera, seen from the middle of the splats.
    azimuth: float = 25.0
    #: Of the camera; between -90 and 90, both excluded.
    elevation: float = 0.0
    #: Vertical field of view.
    fov: float = 25.0
    #: Of the place the light comes from; beyond 90 it stands behind.
    light_azimuth: float = -20.0
    #: Of the place the light comes from.
    light_elevation: float = 30.0
    #: Of a second light, without shadows, from beside the camera: its share of the first one's
    #: strength. 0 for none.
    fill: float = 0.1
    #: Of the PNG, in stops: each doubles its brightness. The EXR is never changed by it.
    exposure: float = 0.0
    #: Whether light spreads below the surface. Without, it leaves where it enters, in the same
    #: color.
    scattering: bool = True
    #: Whether the splats wear the albedo that they carry, as the built-in bust does. Without, color
    #: is the material's own.
    albedo: bool = True
    #: Number of splats of the built-in bust.
    count: int = 200_000
    #: Upward axis of the PLY file.
    up: UpAxis = "y"
    #: Size of the body: at 0.2 the bust is 7 cm tall, and light goes five times as far in it.
    scale: float = 1.0

    def check(self) -> None:
        """Raise `ValueError` for a fill, an exposure or an angle that cannot be."""
        if not 0 <= self.fill < math.inf:
            raise ValueError(
                f"--fill is {self.fill:g}; it is a share of the light's strength: 0 or more"
            )
        if not math.isfinite(self.exposure):
            raise ValueError(
                f"--exposure is {self.exposure:g}; it must be a finite number of stops"
            )
        for name in ("azimuth", "light_azimuth", "light_elevation"):
            if not math.isfinite(value := getattr(self, name)):
                raise ValueError(
                    f"--{name.replace('_', '-')} is {value:g}; it must be a finite number of "
                    "degrees"
                )
        for name in ("width", "height", "count"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name} is {getattr(self, name)}; it must be 1 or more")
        check_scale(self.scale)
        if not 0 < self.fov < 180:
            raise ValueError(
                f"--fov is {self.fov:g}; it must lie between 0 and 180 degrees, both excluded"
            )
        if not -90 < self.elevation < 90:
            raise ValueError(
                f"--elevation is {self.elevation:g}; it must lie between -90 and 90 degrees, both "
                "excluded"
            )
        if self.splats is None:
            fits = f"take {free_bytes() / _BYTES_PER_SPLAT:.0f} at most"
            check_memory(f"--count {self.count}", _BYTES_PER_SPLAT * self.count, fits)
        fits = f"take {free_bytes() / _BYTES_PER_PIXEL:.0f} pixels at most"
        check_memory(
            f"--width {self.width} --height {self.height}",
            _BYTES_PER_PIXEL * self.width * self.height,
            fits,
        )

    def load(self) -> tuple[sj.Splats, sj.Material]:
        """Give the splats, and the material as it is rendered with them."""
        material = sj.load_material(self.material)
        splats = self.splats_to_show()
        return splats, self.material_for(splats, material)

    def material_for(self, splats: sj.Splats, material: sj.Material) -> sj.Material:
        """Give a material as it is rendered with splats."""
        if splats.albedo is not None:
            material = material.white()
            note(
                f"color is the splats' own albedo, and {self.material} only spreads the light; "
                "--no-albedo shows its own color"
            )
        material = in_color(material)
        return material if self.scattering else material.opaque()

    def splats_to_show(self) -> sj.Splats:
        """Read the splats, or make the bust."""
        if self.splats is None:
            with stage(f"making the bust with {self.count} splats"):
                return self.as_shown(sj.bust(self.count))
        with stage(f"reading {self.splats}"):
            return self.as_shown(sj.read_splats(self.splats, up=self.up))

    def as_shown(self, splats: sj.Splats) -> sj.Splats:
        """Give splats in the size that is asked for, with their albedo, or without."""
        splats = splats if self.scale == 1 else splats.scaled(self.scale)
        return (
            splats
            if self.albedo
            else eqx.tree_at(
                lambda each: each.albedo, splats, None, is_leaf=lambda leaf: leaf is None
            )
        )

    def lights(
        self, channels: int, azimuth: float, light_azimuth: float
    ) -> tuple[sj.DirectionalLight, ...]:
        """Give the light, and the fill beside a camera at an azimuth: on the same side of it
        wherever it goes.
        """
        # On a white diffuser that faces it, the first light gives radiance 1.
        irradiance = jnp.full(channels, jnp.pi)
        key = sj.DirectionalLight(
            direction=-towards(light_azimuth, self.light_elevation), irradiance=irradiance
        )
        if self.fill == 0:
            return (key,)
        side = math.copysign(_FILL_SIDE, math.remainder(self.azimuth - self.light_azimuth, 360))
        beside = towards(azimuth + side, _FILL_ELEVATION)
        return key, sj.DirectionalLight(
            direction=-beside, irradiance=self.fill * irradiance, cast_shadows=False
        )

    def camera(self, splats: sj.Splats, azimuth: float) -> sj.Camera:
        """Give the camera at an azimuth."""
        return frame_all(
            splats, towards(azimuth, self.elevation), self.fov, self.width, self.height
        )

    def write(self, path: Path, frame: sj.Frame, material: sj.Material) -> tuple[Path, Path]:
        """Write the picture with all its layers, and the PNG file beside it; give both paths."""
        beside = path.with_suffix(".png")
        sj.write_exr(
            path, frame, variances=material.gaussians.variances.tolist(), manifest=self.manifest()
        )
        sj.write_png(beside, frame, exposure=self.exposure)
        return path, beside

    def manifest(self) -> dict[str, Any]:
        """Give all that the pictures depend on: options by their names, what is in the files they
        name, and versions.
        """
        options = {
            name: value for name, value in asdict(self).items() if name not in ("splats", "output")
        }
        return {f"--{name.replace('_', '-')}": value for name, value in options.items()} | {
            "splats": "the built-in bust"
            if self.splats is None
            else f"{self.splats.name}, {fingerprint(self.splats)}",
            "contents of --material": material_path(self.material).read_text(encoding="utf-8"),
            "precision": str(jnp.result_type(float)),
            "splatjax": own_version(),
            "jax": jax.__version__,
        }

    def say_what_was_handed_over(self, frame: sj.Frame, material: sj.Material) -> None:
        """Say which layers are narrower than the splats."""
        if not self.scattering:
            return
        handed_over = frame.handed_over > 0.5
        widths = ", ".join(
            f"{float(v) ** 0.5:.3g}"
            for v, there in zip(material.gaussians.variances, handed_over, strict=True)
            if there
        )
        if widths:
            note(
                "narrower than the splats, so that the surface's own light stands for them: "
                "Gaussians of standard deviations "
                f"{widths} mm; more splats show them, or a smaller body (--scale)"
            )


def check_scale(scale: float) -> None:
    """Raise `ValueError` for a size that no body has."""
    if not 0 < scale < math.inf:
        raise ValueError(
            f"--scale is {scale:g}; it must be a positive factor: 1 shows a body as large as it is"
        )


def draw(scene: sj.Scene, camera: sj.Camera, plan: sj.Plan) -> sj.Frame:
    """Render, and wait for the picture.

    **Raises:** `ValueError` when the plan lacks room.
    """
    frame = jax.block_until_ready(sj.render(scene, camera, plan=plan))
    if not frame.overflow <= 0:
        raise ValueError(
            f"the plan lacks room: {float(frame.overflow):.2f} times what it holds is needed"
        )
    return frame


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


def towards(azimuth: float, elevation: float) -> jax.Array:
    """Give the unit vector from the middle towards a place on the sky, given in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    across = math.cos(elevation)
    return jnp.asarray(
        [math.sin(azimuth) * across, math.sin(elevation), math.cos(azimuth) * across], float
    )


def frame_all(
    splats: sj.Splats, direction: jax.Array, fov: float, width: int, height: int
) -> sj.Camera:
    """Place a camera in a direction so that the bounding sphere of the splats just fits the
    narrower side of the picture.
    """
    return frame_parts(lambda: iter([splats]), direction, fov, width, height)


def frame_parts(
    parts: Parts, direction: jax.Array, fov: float, width: int, height: int
) -> sj.Camera:
    """Do the same for splats that come in parts."""
    boxes = [(np.min(part.centers, axis=0), np.max(part.centers, axis=0)) for part in parts()]
    middle = (
        np.min([low for low, _ in boxes], axis=0) + np.max([high for _, high in boxes], axis=0)
    ) / 2
    radius = max(
        float(
            np.max(
                np.linalg.norm(np.asarray(part.centers) - middle[None], axis=1)
                + np.asarray(part.radii)
            )
        )
        for part in parts()
    )
    half_angle = math.atan(math.tan(math.radians(fov) / 2) * min(1.0, width / height))
    distance = radius / math.sin(half_angle)
    target = jnp.asarray(middle)
    eye = target + distance * direction.astype(target.dtype)
    return sj.Camera.look_at(eye, target, fov=fov, width=width, height=height)
