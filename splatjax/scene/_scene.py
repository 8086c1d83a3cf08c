"""Scenes (splats of a material under lights), cameras, and rendered frames."""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax._chunking import take_rows
from splatjax._display import png_of, to_display
from splatjax._records import (
    Numbers,
    as_floats,
    check_values,
    is_traced,
    numbers,
    plain_int,
    record,
    require,
    several,
    valid,
)

from ._lights import AbstractLight
from ._material import Material

_PARALLEL = 1e-6  # sine of an angle below the resolution of float32
_FARTHEST = 1e15  # float32 can represent the square, and larger products with it
_ORTHONORMAL = 1e-2  # tolerance of products of the axes of a camera
_PIXELS = valid("at least 1 (pixels), an int", lambda x: (x >= 1) & (x.dtype.kind in "iu"))


@record
class Camera(eqx.Module):
    r"""A pinhole camera; `Camera.look_at` places one by position and target.

    Pixel centers are at half integers, and the origin of the picture is its top left corner. In
    camera coordinates x points right, y points down, and z points into the picture.

    **Attributes:**

    - `position`: the pinhole, mm. Differentiable.
    - `rotation`: rotation from world to camera; its rows are the right, down and forward axes of
      the camera, orthonormal. Differentiable.
    - `focal_length`: focal length divided by the height of the picture: `1 / (2 tan(fov / 2))` for
      a vertical field of view `fov`. Differentiable.
    - `width`, `height`: size of the picture, pixels. Static.
    - `near`: least depth of the centers of splats that are rendered, mm. Static.
    - `principal_point`: where the forward axis meets the picture: column divided by `width` and row
      divided by `height`. `None` is the middle, `[0.5, 0.5]`. Differentiable.

    **Raises:** `ValueError` for a size or a number out of range, and for axes not orthonormal.
    """

    position: Float[Array, "3"] = eqx.field(converter=numbers, metadata=valid("finite (mm)"))
    rotation: Float[Array, "3 3"] = eqx.field(converter=numbers, metadata=valid("finite"))
    focal_length: Float[Array, ""] = eqx.field(
        converter=numbers, metadata=valid("positive", lambda x: x > 0)
    )
    width: int = eqx.field(static=True, converter=plain_int, metadata=_PIXELS)
    height: int = eqx.field(static=True, converter=plain_int, metadata=_PIXELS)
    near: float = eqx.field(static=True, default=1e-2)
    principal_point: Float[Array, "2"] | None = eqx.field(
        converter=numbers, default=None, metadata=valid("finite (over width and height)")
    )

    def __check_init__(self):
        if isinstance(self.rotation, jax.Array) and not is_traced(self.rotation):
            rotation = np.asarray(self.rotation, float)
            check_values(
                "products of the rows of Camera.rotation minus the identity, and its hand minus 1,",
                np.append(rotation @ rotation.T - np.eye(3), np.sign(np.linalg.det(rotation)) - 1),
                "0: right, down and forward are orthonormal and right-handed",
                lambda x: np.abs(x) < _ORTHONORMAL,
            )

    @property
    def principal_pixel(self) -> tuple[Any, Any]:
        """Return the column and row, in pixels, where the forward axis meets the picture."""
        x, y = (0.5, 0.5) if self.principal_point is None else self.principal_point
        return x * self.width, y * self.height

    @classmethod
    def look_at(
        cls,
        eye: Numbers,
        target: Numbers,
        *,
        up: Numbers = (0.0, 1.0, 0.0),
        fov: float | int = 30.0,
        width: int = 512,
        height: int = 512,
        near: float | int = 1e-2,
    ) -> "Camera":
        """Place a camera at `eye` that looks at `target`.

            camera = Camera.look_at((66, 4, 140), (0, -9, 0), fov=30, width=640, height=480)

        **Arguments:**

        - `eye`, `target`: mm. `target` appears in the middle of the picture.
        - `up`: points up in the picture, of any length, not along the line of sight.
        - `fov`: vertical field of view, degrees, between 0 and 180.
        - `width`, `height`: size of the picture, pixels.
        - `near`: splats nearer than this (mm) are not rendered.

        **Raises:** `ValueError` if the field of view or the size of the picture is out of range, if
        `eye` equals `target`, or if `up` is along the line of sight. The last two are not checked
        for traced arrays.
        """
        check_values("fov", fov, "between 0 and 180 degrees", lambda x: (x > 0) & (x < 180))
        eye, target, up = points = as_floats([eye, target, up], name="eye, target and up")
        forward = target - eye
        if not is_traced(points):
            checked, direction = np.asarray(points, np.float64), np.asarray(forward, np.float64)
            check_values(
                "eye, target and up",
                checked,
                f"finite and below {_FARTHEST:g} mm",
                lambda x: np.abs(x) < _FARTHEST,
            )
            require(
                np.linalg.norm(direction) > 0,
                f"eye and target are both {checked[0].tolist()}; move one of them",
            )
            smallest = _PARALLEL * np.linalg.norm(direction) * np.linalg.norm(checked[2])
            require(
                np.linalg.norm(np.cross(direction, checked[2])) > smallest,
                f"up is {checked[2].tolist()}, along the line of sight; give another, such as "
                "[0, 0, -1] to look down",
            )
        rotation = rotation_towards(forward / jnp.linalg.norm(forward), up)
        focal_length = as_floats(0.5 / math.tan(math.radians(fov) / 2), eye.dtype)
        return cls(eye, rotation, focal_length, width, height, near)


def rotation_towards(forward: Float[Array, "3"], up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Build the rotation whose rows point right, down and along `forward`, a unit vector."""
    right = jnp.cross(forward, up)
    right = right / jnp.linalg.norm(right)
    return jnp.stack([right, jnp.cross(forward, right), forward])


def rotation_by(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Compute the rotation about a vector by its length in radians. Differentiable, also at 0.

        R = 1 + sin(t) / t [v] + (1 - cos t) / t^2 [v]^2,   t = |v|

    **Source:** Rodrigues 1840.
    """

    def sinc(y):  # sin(t) / t as a function of y = t^2, by its series near 0
        is_small = y < 1e-2
        t = jnp.sqrt(jnp.where(is_small, 1.0, y))
        return jnp.where(is_small, 1 - y / 6 * (1 - y / 20 * (1 - y / 42)), jnp.sin(t) / t)

    squared, identity = vector @ vector, jnp.eye(3, dtype=vector.dtype)
    cross = jnp.cross(identity, vector[None])
    return identity + sinc(squared) * cross + 0.5 * sinc(squared / 4) ** 2 * (cross @ cross)


_ROUNDING = 1e-5  # tolerance for albedos outside [0, 1]
_FINITE = valid("finite; remove such splats before rendering")
_NOT_NEGATIVE = valid("finite and at least 0", lambda x: x >= 0)


@record
class Splats(eqx.Module):
    r"""The surface of a body as overlapping discs, one row per splat. Coordinates are in mm,
    right-handed, with +y up. `bust`, `sample_mesh` and `read_splats` make them, or the constructor:

        splats = Splats([[0, 0, 0]], [[0, 0, 1]], radii=[1.5], areas=[1])

    Splats that are near in space should be near in memory, as `read_splats` and `sample_mesh` sort
    them. The order affects the speed, not the picture.

    **Attributes:** (all differentiable unless stated otherwise)

    - `centers`: mm. Coverage and shading are smooth functions of the centers; visibility is
      discontinuous. `splatjax.geometry.complete_splats` estimates the rest for bare points.
    - `normals`: outward unit vectors.
    - `radii`: mm, positive; about 1.5 times the square root of the area, so that the overlapping
      discs leave no holes.
    - `areas`: the surface area that each splat represents, mm^2. The areas sum to the area of the
      surface; they are not `pi r^2`, because the discs overlap.
    - `albedo`: diffuse color, linear, in [0, 1], which multiplies the color of the material; `None`
      for 1.
    - `specular`, `roughness`: factors of those of the material; `None` for 1.
    - `weights`: factor of the material's weights for each Gaussian and channel, which varies the
      material over the body (freckles, lips, veins); `None` for 1.

    **Raises:** `ValueError` for arrays of different lengths, for entries that are not finite, for
    negative radii, areas or factors, and for an albedo outside [0, 1].
    """

    centers: Float[Array, "splats 3"] = eqx.field(converter=numbers, metadata=_FINITE)
    normals: Float[Array, "splats 3"] = eqx.field(converter=numbers, metadata=_FINITE)
    radii: Float[Array, " splats"] = eqx.field(converter=numbers, metadata=_NOT_NEGATIVE)
    areas: Float[Array, " splats"] = eqx.field(converter=numbers, metadata=_NOT_NEGATIVE)
    albedo: Float[Array, "splats channels"] | None = eqx.field(
        converter=numbers,
        default=None,
        metadata=valid(
            "in [0, 1]: linear colors, 8-bit values divided by 255 and decoded",
            lambda x: (x >= -_ROUNDING) & (x <= 1 + _ROUNDING),
        ),
    )
    specular: Float[Array, " splats"] | None = eqx.field(
        converter=numbers, default=None, metadata=_NOT_NEGATIVE
    )
    roughness: Float[Array, " splats"] | None = eqx.field(
        converter=numbers, default=None, metadata=_NOT_NEGATIVE
    )
    weights: Float[Array, "splats gaussians channels"] | None = eqx.field(
        converter=numbers, default=None, metadata=_NOT_NEGATIVE
    )

    @property
    def count(self) -> int:
        """Number of splats."""
        return self.centers.shape[0]

    def scaled(self, factor: Float[Array, ""] | float) -> "Splats":
        """Scale the body about the origin by a positive factor. The distance that light travels in
        the material is unchanged, so a smaller body is more translucent.
        """
        check_values("the scale", factor, "positive", lambda x: x > 0)
        return eqx.tree_at(
            lambda body: (body.centers, body.radii, body.areas),
            self,
            (self.centers * factor, self.radii * factor, self.areas * (factor * factor)),
        )

    def without_maps(self) -> "Splats":
        """Remove albedo, specular and roughness, so that the material alone determines color and
        highlights.
        """
        return dataclasses.replace(self, albedo=None, specular=None, roughness=None)

    def take(self, chosen: Int[Array, " chosen"]) -> "Splats":
        """Return the splats at ascending indices. Indices past the end give invisible splats
        without light.
        """
        return jax.tree.map(lambda leaf: take_rows(leaf, chosen), self)


# A function that iterates over all splats in parts, the same parts at every call.
Parts: TypeAlias = Callable[[], Iterable[Splats]]


@record
class Scene(eqx.Module):
    """A body of one material under lights: the differentiable input of `render`.

        scene = Scene(bust(100_000), DirectionalLight((0, 0, -1), 3.14), load_material("marble"))

    **Attributes:** (differentiable)

    - `splats`: the surface of the body.
    - `lights`: one light or several. A light of one channel applies to all channels.
    - `material`: the material of all splats. For splats with an albedo, use `material.white()`, so
      that the albedo alone determines the color.
    """

    splats: Splats
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    material: Material

    def __post_init__(self):
        self.lights = tuple(light.with_channels(self.material.channels) for light in self.lights)


class Frame(eqx.Module):
    r"""A picture in linear light, with row 0 at the top.

    `beauty`, `diffuse`, `specular`, `layers`, `albedo` and `irradiance` are premultiplied by
    coverage; `depth`, `position` and `normal` belong to the front surface and are not
    premultiplied. `diffuse = sum_k weights_k layers_k` everywhere.

    **Attributes:**

    - `beauty`: radiance, `diffuse + specular`, plus `single_scattering` if the material has it.
    - `coverage`: the fraction of each pixel that the body covers, in [0, 1].
    - `depth`: distance along the camera's forward axis, mm; inf where no surface is visible.
    - `position`: in world space, mm; 0 where no surface is visible.
    - `normal`: unit vector in world space; 0 where no surface is visible.
    - `albedo`: albedo of the splats; 1 if they have none.
    - `shadow`: visibility of each light, from 0 in shadow to 1, not premultiplied; 1 where no
      surface is visible.
    - `irradiance`: the irradiance that enters the surface, after cosine, shadow and the loss to the
      specular lobe.
    - `layers`: one per Gaussian, the radiance of light that this Gaussian spreads, without its
      weight.
    - `weights`: the weights with which the layers add up to `diffuse`.
    - `diffuse`, `specular`: radiance.
    - `unresolved_fraction`: how far each layer is too narrow for the splats, from 0 to 1, averaged
      over the covered pixels. This fraction of the layer is not blurred: it is the irradiance.
    - `single_scattering`: radiance, premultiplied; `None` if the material has none.
    - `overflow`: 0 if the capacity of the plan suffices. Otherwise it is the largest ratio of
      needed to planned capacity, and the picture is NaN.
    """

    beauty: Float[Array, "height width channels"]
    coverage: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    albedo: Float[Array, "height width channels"]
    shadow: Float[Array, "lights height width"]
    irradiance: Float[Array, "height width channels"]
    layers: Float[Array, "gaussians height width channels"]
    weights: Float[Array, "gaussians channels"]
    diffuse: Float[Array, "height width channels"]
    specular: Float[Array, "height width channels"]
    unresolved_fraction: Float[Array, " gaussians"]
    overflow: Float[Array, ""]
    single_scattering: Float[Array, "height width channels"] | None = None

    def _repr_png_(self) -> bytes | None:
        """Encode the picture for a notebook as `splatjax.write_png` does; `None` for a batch, and
        for numbers of channels that cannot be displayed.
        """
        if self.beauty.ndim != 3 or self.beauty.shape[-1] not in (1, 3):
            return None
        return png_of(to_display(np.asarray(self.beauty)))
