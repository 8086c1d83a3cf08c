"""A pinhole camera."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

_ALONG = 1e-6
"""Sine of an angle in which single precision knows no direction."""
_FARTHEST = 1e15
"""Numbers that single precision can square, and multiply once more."""


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
    """

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    focal_length: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: float = eqx.field(static=True, default=1e-2)

    @classmethod
    def look_at(
        cls,
        eye: Float[Array, "3"],
        target: Float[Array, "3"],
        *,
        up: Float[Array, "3"] | None = None,
        fov: float = 30.0,
        width: int = 512,
        height: int = 512,
        near: float = 1e-2,
    ) -> "Camera":
        """Place a camera at `eye` (mm) that looks at `target` (mm), with vertical field of view
        `fov` in degrees.

        **Raises:** `ValueError` when the field of view or the size of the picture is out of range,
        and, unless they are traced, for an eye, a target and an `up` on one line.
        """
        if not 0 < fov < 180:
            raise ValueError(f"fov must lie between 0 and 180 degrees, not {fov}")
        if width < 1 or height < 1:
            raise ValueError(
                f"a picture of {width} x {height} pixels has no pixel; width and height must be at "
                "least 1"
            )
        up = jnp.asarray([0.0, 1.0, 0.0], eye.dtype) if up is None else up
        _check_directions(eye, target, up)
        forward = target - eye
        forward = forward / jnp.linalg.norm(forward)
        right = jnp.cross(forward, up)
        right = right / jnp.linalg.norm(right)
        down = jnp.cross(forward, right)
        focal_length = jnp.asarray(0.5 / math.tan(math.radians(fov) / 2), eye.dtype)
        return cls(eye, jnp.stack([right, down, forward]), focal_length, width, height, near)


def _check_directions(
    eye: Array | np.ndarray, target: Array | np.ndarray, up: Array | np.ndarray
) -> None:
    """Refuse what gives no axes; traced values are trusted."""
    if any(isinstance(each, Tracer) for each in (eye, target, up)):
        return
    eye, target, upright = (np.asarray(each, np.float64) for each in (eye, target, up))
    if not np.max(np.abs([eye, target, upright])) < _FARTHEST:
        raise ValueError(
            f"from the camera to its target it is {(target - eye).tolist()} mm, and up is "
            f"{upright.tolist()}; give less"
        )
    forward = target - eye
    if not np.linalg.norm(forward) > 0:
        raise ValueError(
            f"the camera stands at {eye.tolist()}, where it looks at; move one of them"
        )
    if not np.linalg.norm(np.cross(forward, upright)) > _ALONG * np.linalg.norm(
        forward
    ) * np.linalg.norm(upright):
        raise ValueError(
            f"up is {upright.tolist()}, along the line of sight; give another, such as [0, 0, -1] "
            "to look down"
        )
