"""A small rasterizer of triangles: the visible face of every pixel, and interpolated attributes of
its corners.

A corner lands at `(x, y)` pixels with a weight `w`: its depth in perspective, 1 otherwise. Seen
from a pixel center `p` it lies at `q_i = w_i ((x_i, y_i) - p)`, which is linear on the face, so
that the barycentric coordinates of what the pixel sees are

    b_i = (q_j x q_k) / sum of all three,    sum_i b_i q_i = 0

They are perspective-correct, and differentiable in every corner. The choice of the face has no
derivative.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import with_spare
from splatjax.splatting import AbstractView, PerspectiveView

# Fraction of its extent by which a face is enlarged: a pixel on an edge belongs to both faces.
_ON_THE_EDGE = 1e-4
_AS_NEAR = 1e-6  # of the depth; among faces this close, the one with the highest number is visible


class Landing(eqx.Module):
    r"""The positions of the corners of faces in a picture.

    **Attributes:** (differentiable)

    - `x`, `y`: pixels, origin top left.
    - `w`: depth in perspective, 1 otherwise.
    - `depth`: mm; the face of the least depth is visible.
    - `shown`: whether the face is drawn at all.
    - `width`, `height`: of the picture, pixels. Static.
    """

    x: Float[Array, "faces 3"]
    y: Float[Array, "faces 3"]
    w: Float[Array, "faces 3"]
    depth: Float[Array, "faces 3"]
    shown: Bool[Array, " faces"]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    @classmethod
    def in_view(cls, corners: Float[Array, "faces 3 3"], view: AbstractView) -> "Landing":
        """Project faces (mm) in a view. A face that shows its back, or reaches in front of the near
        plane, is not drawn.
        """
        x, y, depth = view.project(corners.transpose(2, 0, 1))
        in_perspective = isinstance(view, PerspectiveView)
        w = depth if in_perspective else jnp.ones_like(depth)
        beyond = (
            jnp.all(depth > view.near, axis=1) if in_perspective else jnp.ones(len(depth), bool)
        )
        return cls(
            x, y, w, depth, beyond & (_turn(x, y) < 0), view.width, view.height
        )  # y points down

    @classmethod
    def in_texture(cls, uvs: Float[Array, "faces 3 2"], resolution: int) -> "Landing":
        """Place faces in a square texture of `resolution` texels per edge, v up. Where faces
        overlap, the last one is drawn.
        """
        x, y = resolution * uvs[..., 0], resolution * (1 - uvs[..., 1])
        shown = jnp.abs(_turn(x, y)) > 0
        return cls(x, y, jnp.ones_like(x), jnp.zeros_like(x), shown, resolution, resolution)

    def boxes(self) -> tuple[Int[Array, " faces"], ...]:
        """Find the first column and row whose centers a face may cover, and the number of columns
        and rows; 0 for a face that is not drawn.
        """
        begin, size = [], []
        for place, count in ((self.x, self.width), (self.y, self.height)):
            place = jnp.clip(stop_gradient(place), -1.0, count + 1.0)
            slack = _ON_THE_EDGE * (jnp.max(place, axis=1) - jnp.min(place, axis=1))
            first = jnp.maximum(jnp.ceil(jnp.min(place, axis=1) - slack - 0.5), 0).astype(jnp.int32)
            last = jnp.minimum(jnp.floor(jnp.max(place, axis=1) + slack - 0.5), count - 1).astype(
                jnp.int32
            )
            begin.append(first)
            size.append(jnp.where(self.shown, jnp.maximum(last - first + 1, 0), 0))
        return *begin, *size


class SeenFaces(eqx.Module):
    """The visible face at every pixel; 0 where there is none."""

    faces: Int[Array, "height width"]
    covered: Bool[Array, "height width"]
    needed: Float[Array, ""]
    """Number of fragments divided by their capacity; above 1, some are missing."""


def capacity_for(landing: Landing) -> int:
    """Return the capacity of `see_faces` for a concrete landing, plus an eighth for motion."""
    _, _, across, down = landing.boxes()
    return with_spare("fragments", 9 * int(jnp.sum(across * down)) // 8, 1024)


def see_faces(landing: Landing, capacity: int) -> SeenFaces:
    r"""Find the nearest face under every pixel center. Not differentiated.

    Every face is tested at the pixels of its box; of the faces that cover a pixel, the one with the
    least depth wins.

    **Arguments:**

    - `landing`: from `Landing.in_view` or `Landing.in_texture`.
    - `capacity`: most pixels of all boxes together (`capacity_for`). Static.

    **Returns:** `SeenFaces`.
    """
    landing = stop_gradient(landing)
    left, top, across, down = landing.boxes()
    counts = across * down
    ends = jnp.cumsum(counts)
    face = jnp.repeat(
        jnp.arange(len(counts), dtype=jnp.int32), counts, total_repeat_length=capacity
    )
    within = jnp.arange(capacity, dtype=jnp.int32) - (ends - counts)[face]
    is_fragment = jnp.arange(capacity, dtype=jnp.int32) < ends[-1]
    wide = jnp.maximum(across[face], 1)
    column, row = left[face] + within % wide, top[face] + within // wide
    shares = _barycentrics(landing, face, column, row)
    inside = is_fragment & jnp.all(shares >= -_ON_THE_EDGE, axis=1)
    depth = jnp.sum(shares * landing.depth[face], axis=1)
    pixels = landing.width * landing.height
    pixel = jnp.where(inside, row * landing.width + column, pixels)
    nearest = jnp.full(pixels, jnp.inf, depth.dtype).at[pixel].min(depth, mode="drop")
    limit = nearest + _AS_NEAR * jnp.abs(nearest)
    first = inside & (depth <= limit.at[pixel].get(mode="fill", fill_value=-jnp.inf))
    seen = (
        jnp.full(landing.width * landing.height, -1, jnp.int32)
        .at[jnp.where(first, pixel, len(nearest))]
        .max(face, mode="drop")
    )
    seen = seen.reshape(landing.height, landing.width)
    return SeenFaces(jnp.maximum(seen, 0), seen >= 0, ends[-1].astype(depth.dtype) / capacity)


def barycentrics(landing: Landing, seen: SeenFaces) -> Float[Array, "height width 3"]:
    """Compute the perspective-correct barycentric coordinates at every pixel center, with sum 1.
    Differentiable in the landing.

    Without a visible face, each is 1/3.
    """
    row, column = jnp.indices((landing.height, landing.width), dtype=jnp.int32)
    interpolated = _barycentrics(
        landing,
        seen.faces.reshape(-1),
        column.reshape(-1),
        row.reshape(-1),
        seen.covered.reshape(-1),
    )
    return interpolated.reshape(landing.height, landing.width, 3)


def interpolate(
    values: Float[Array, "faces 3 rows"], seen: SeenFaces, shares: Float[Array, "height width 3"]
) -> Float[Array, "height width rows"]:
    """Interpolate attributes of the corners of faces; 0 without a visible face. Differentiable in
    the values and the shares.
    """
    interpolated = jnp.sum(values[seen.faces] * shares[..., None], axis=2)
    return jnp.where(seen.covered[..., None], interpolated, 0.0)


def _barycentrics(landing: Landing, face, column, row, valid=None) -> Float[Array, "pixels 3"]:
    dtype = landing.x.dtype
    w = landing.w[face]
    qx = w * (landing.x[face] - (column.astype(dtype) + 0.5)[:, None])
    qy = w * (landing.y[face] - (row.astype(dtype) + 0.5)[:, None])
    doubled = jnp.stack(
        [qx[:, j] * qy[:, k] - qx[:, k] * qy[:, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1
    )
    total = jnp.sum(doubled, axis=1, keepdims=True)
    drawn = total != 0 if valid is None else (total != 0) & valid[:, None]
    return jnp.where(
        drawn, doubled / jnp.where(drawn, total, 1.0), 1 / 3 if valid is not None else -1.0
    )


def _turn(x: Float[Array, "faces 3"], y: Float[Array, "faces 3"]) -> Float[Array, " faces"]:
    """Compute twice the area of a triangle in the picture, positive when its corners turn from x
    towards y.
    """
    x, y = stop_gradient(x), stop_gradient(y)
    return (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
