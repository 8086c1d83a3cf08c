"""A pinhole camera."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax._records import Numbers, as_floats, check_values, numbers, record

_PARALLEL = 1e-6  # sine of an angle that single precision does not resolve
_FARTHEST = 1e15  # single precision can square such a number, and multiply the square once more


@record
class Camera(eqx.Module):
    r"""A pinhole camera.

    Pixel centers lie at half integers, the origin of the picture is its top left corner. In camera
    coordinates x goes right, y goes down, z goes into the picture.

    **Attributes:**

    - `position`: the pinhole, mm. Differentiable.
    - `rotation`: world to camera; its rows are the camera's right, down and forward axes,
      orthonormal. Differentiable.
    - `focal_length`: in heights of the picture: `1 / (2 tan(fov / 2))` for a vertical field of view
      `fov`. Differentiable.
    - `width`, `height`: of the picture, pixels. Static.
    - `near`: splats whose center is nearer than this, along the forward axis, are not drawn; mm.
      Static.

    **Raises:** `ValueError` for a picture without pixels, and for numbers that are not finite.
    """

    position: Float[Array, "3"] = eqx.field(converter=numbers)
    rotation: Float[Array, "3 3"] = eqx.field(converter=numbers)
    focal_length: Float[Array, ""] = eqx.field(converter=numbers)
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: float = eqx.field(static=True, default=1e-2)

    def __check_init__(self):
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"a picture of {self.width} x {self.height} pixels has no pixel; width and height "
                "must be at least 1"
            )
        check_values("Camera.position", self.position, "finite (mm)", lambda x: x == x)
        check_values("Camera.rotation", self.rotation, "finite", lambda x: x == x)
        check_values("Camera.focal_length", self.focal_length, "positive", lambda x: x > 0)

    @classmethod
    def look_at(
        cls,
        eye: Numbers,
        target: Numbers,
        *,
        up: Numbers | None = None,
        fov: float | int = 30.0,
        width: int = 512,
        height: int = 512,
        near: float | int = 1e-2,
    ) -> "Camera":
        """Place a camera at `eye` (mm) that looks at `target` (mm), with vertical field of view
        `fov` in degrees; `up` is y unless given.

        **Raises:** `ValueError` when the field of view or the size of the picture is out of range,
        and, unless they are traced, for an eye, a target and an `up` on one line.
        """
        if not 0 < fov < 180:
            raise ValueError(f"fov must lie between 0 and 180 degrees, not {fov}")
        up = (0.0, 1.0, 0.0) if up is None else up
        points = as_floats([eye, target, up], name="eye, target and up")
        eye, target, up = points
        forward = target - eye
        if not isinstance(points, Tracer):
            known, way = np.asarray(points, np.float64), np.asarray(forward, np.float64)
            if not np.max(np.abs(known)) < _FARTHEST:
                raise ValueError(
                    f"the vector from the camera to its target is {way.tolist()} mm, and up is "
                    f"{known[2].tolist()}; both must be finite and below {_FARTHEST:g}"
                )
            if not np.linalg.norm(way) > 0:
                raise ValueError(f"eye and target are both {known[0].tolist()}; move one of them")
            smallest = _PARALLEL * np.linalg.norm(way) * np.linalg.norm(known[2])
            if not np.linalg.norm(np.cross(way, known[2])) > smallest:
                raise ValueError(
                    f"up is {known[2].tolist()}, along the line of sight; give another, such as "
                    "[0, 0, -1] to look down"
                )
        forward = forward / jnp.linalg.norm(forward)
        right = jnp.cross(forward, up)
        right = right / jnp.linalg.norm(right)
        rotation = jnp.stack([right, jnp.cross(forward, right), forward])
        focal_length = 0.5 / math.tan(math.radians(fov) / 2)
        return cls(eye, rotation, as_floats(focal_length, eye.dtype), width, height, near)
