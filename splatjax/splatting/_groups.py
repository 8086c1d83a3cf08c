"""Groups of consecutive splats: merging into discs for coarse shadow maps, and the visibility
between groups, by bundles of parallel lines.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from splatjax._chunking import map_chunks
from splatjax._combination import DeviceMesh
from splatjax._records import record, valid
from splatjax.scene import Splats, even_directions

MERGED_COUNTS = 8, 16, 32  # consecutive splats that are near each other in the order of a plan


def merge_splats(splats: Splats, count: int) -> Splats:
    """Merge every `count` consecutive splats into one disc for each side of the surface.

    A disc has the area-weighted mean center, the mean normal, and the total area of its splats.

    Splats of a group that face away from its first one belong to the other side. A disc without
    splats has no extent and no normal.

    **Arguments:**

    - `splats`: a multiple of `count`, in a compact order. Differentiable; the sides are constants.

    **Returns:** twice as many discs as there are groups, without maps.
    """

    def grouped(rows):
        return rows.reshape(-1, count, *rows.shape[1:])

    centers, normals = grouped(splats.centers), grouped(splats.normals)
    is_front = jnp.sum(stop_gradient(normals * normals[:, :1]), axis=2) >= 0

    def of_side(belongs):
        areas, squares = (
            jnp.where(belongs, grouped(rows), 0.0) for rows in (splats.areas, splats.radii**2)
        )
        area, square = jnp.sum(areas, axis=1), jnp.sum(squares, axis=1)
        exists = (area > 0) & (square > 0)
        weights = areas / jnp.where(exists, area, 1.0)[:, None]
        center, normal = (jnp.sum(weights[..., None] * rows, axis=1) for rows in (centers, normals))
        length = jnp.sqrt(jnp.where(exists, jnp.sum(normal**2, axis=1), 1.0))
        radius = jnp.where(exists, jnp.sqrt(jnp.where(exists, square, 1.0)), 0.0)
        normal = jnp.where(exists[:, None], normal / length[:, None], 0.0)
        return Splats(center, normal, radius, area)

    front, back = of_side(is_front), of_side(~is_front)
    return jax.tree.map(lambda *sides: jnp.concatenate(sides), front, back)


_MOST_GROUPS = 90_000
_LARGEST_GROUP = 32  # splats, a block of the plan's order
_CELL = 1.35  # edge of a cell, in spacings: smaller ones leak, larger ones widen rims
_SPARSE = 0.9  # quantile of the splats' areas by which cells are measured
_CLEARANCE = 0.5  # height of either end of a line above the plane of the other, in spacings
_CANDIDATES = 4  # ends that are tried on every line
_LEAST_NORMAL = 1e-3  # length of the mean normal of a group
_AT_ONCE = 1 << 19  # pairs of splat and direction


@record
class SightlineSettings(eqx.Module):
    r"""Settings of the visibility between splats. Static.

    **Attributes:**

    - `directions`: number of directions over the sphere, even; the same for all splats.
    """

    directions: int = eqx.field(
        static=True,
        default=256,
        metadata=valid("an even number of 2 or more", lambda n: (n >= 2) & (n % 2 == 0)),
    )


class Sightlines(eqx.Module):
    r"""The visibility between splats, in directions evenly distributed over the sphere.

    Consecutive splats in a compact order form groups. A group has one view, and the exitance of its
    first splat.

    **Attributes:** not differentiated

    - `directions`: unit.
    - `seen`: the visible group from each group in each direction; the number of groups if there is
      none.
    - `size`: splats in each group. Static.

    **Source:** Sbert 1993, "An integral geometry based method for fast form-factor computation".
    """

    directions: Float[Array, "directions 3"]
    seen: Int[Array, "groups directions"]
    size: int = eqx.field(static=True)

    @classmethod
    def build(cls, splats: Splats, settings: SightlineSettings) -> "Sightlines":
        """Compute the visibility between splats, by NumPy.

        For every line, splats are sorted into cells across it, and by depth along it. A splat sees
        the next one in its cell that faces it. Each must be in front of the other's plane by half a
        spacing, so that a rough surface does not see itself.

        **Arguments:**

        - `splats`: concrete, in the order of a plan; splats without area are padding.
        """
        size = 1
        while size < _LARGEST_GROUP and splats.count > _MOST_GROUPS * size:
            size *= 2
        centers, normals, areas = map(np.asarray, (splats.centers, splats.normals, splats.areas))
        areas = areas.reshape(-1, size)
        total = np.maximum(areas.sum(axis=1), np.finfo(areas.dtype).tiny)
        centers, normals = (
            np.einsum("gs,gsi->gi", areas / total[:, None], rows.reshape(-1, size, 3))
            for rows in (centers, normals)
        )
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), _LEAST_NORMAL)
        # Groups without area have no normal: they neither see nor are seen, wherever they are.
        exists = areas.sum(axis=1) > 0
        if not exists.any():
            exists[:1] = True
        centers = np.where(exists[:, None], centers - centers[exists].mean(axis=0), 0)
        spacing = np.sqrt(np.quantile(total[exists], _SPARSE))
        count = settings.directions
        lines = even_directions(count)[: count // 2]
        seen = np.empty((count, len(exists)), np.int32)
        for i, line in enumerate(lines):
            seen[i], seen[i + count // 2] = _ends(line, centers, normals, spacing)
        directions = np.concatenate([lines, -lines]).astype(centers.dtype)
        return cls(jnp.asarray(directions), jnp.asarray(seen.T), size)

    def irradiance(
        self,
        exitance: Float[Array, "channels groups"],
        normals: Float[Array, "splats 3"],
        combination: DeviceMesh,
    ) -> Float[Array, "channels splats"]:
        r"""Compute the irradiance from a body that radiates equally in all directions,

            E(x) = sum_d max(n . d, 0) M(y_d) / sum_d max(n . d, 0)

        where `y_d` is the point that x sees along d. In a closed cavity of constant exitance the
        irradiance equals the exitance.

        **Arguments:**

        - `exitance`: exitance of the first splat of each group of this device. Differentiable.
        - `normals`: unit, or zero for padding. Differentiable.
        """
        everywhere = combination.gather(exitance.T)

        def of_groups(normals, seen):
            normals = normals.reshape(len(seen), self.size, 3)
            cosines = jnp.maximum(normals @ self.directions.T, 0)
            total = jnp.sum(cosines, axis=-1, keepdims=True)
            light = everywhere.at[seen].get(mode="fill", fill_value=0)
            received = cosines / jnp.where(total > 0, total, 1.0) @ light
            return received.reshape(len(seen), -1)

        rows = normals.reshape(len(self.seen), 3 * self.size)
        at_once = max(_AT_ONCE // (self.size * len(self.directions)), 1)
        received = map_chunks(of_groups, rows, self.seen, at_once=at_once)
        return received.reshape(-1, len(exitance)).T


def _ends(line, centers, normals, spacing):
    """Return for each splat the visible splat along a line, and against it; the number of splats if
    there is none.
    """
    # Number the cells of a grid across the line, and sort by cell and depth.
    count = len(centers)
    across = np.cross(line, np.eye(3)[np.argmin(np.abs(line))])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(line, across)], axis=1).astype(centers.dtype)
    cells = np.floor(centers @ axes / (_CELL * spacing)).astype(np.int64)
    cells -= cells.min(axis=0)
    numbered = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    depth = centers @ line.astype(centers.dtype)
    depth = (depth - depth.min()) / max(np.ptp(depth), spacing)
    order = np.argsort(numbered + 0.999 * depth.astype(np.float64))
    cosine = (normals @ line.astype(centers.dtype))[order]
    cell, centers, normals = numbered[order], centers[order], normals[order]
    for sign in (1, -1):
        if sign < 0:
            order, cosine, cell = order[::-1], -cosine[::-1], cell[::-1]
            centers, normals = centers[::-1], normals[::-1]
        # From each position of the sequence on, the next splat that faces back.
        places = np.where(cosine < 0, np.arange(count), count)
        following = np.append(np.minimum.accumulate(places[::-1])[::-1], [count, count])
        cell_of_end = np.append(cell, -1)
        ends = np.full(count, count)
        start = np.flatnonzero(cosine > 0)
        end = following[start + 1]
        for _ in range(_CANDIDATES):
            inside = cell[start] == cell_of_end[end]
            start, end = start[inside], end[inside]
            between = centers[end] - centers[start]
            above = np.minimum(
                np.sum(between * normals[start], axis=1), -np.sum(between * normals[end], axis=1)
            )
            clear = above > _CLEARANCE * spacing
            ends[order[start[clear]]] = order[end[clear]]
            start, end = start[~clear], following[end[~clear] + 1]
        yield ends
