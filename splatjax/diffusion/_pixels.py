"""The points that pixels see, in tiles, and what lies near each tile."""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.splatting import AbstractView, BinCapacity, Bins, TileGrid, TileRanges, bin_items

from ._gaussian_sums import Steps
from ._neighbors import Boxes

FAR = -1e6  # mm from anything, yet with a square that float32 holds
_SIDE = 8
_LANES = 32


def tile_grid(width: int, height: int, slots: int) -> TileGrid:
    """The tiles of two surfaces of a picture, one below the other."""
    return TileGrid(width, 2 * -(-height // _SIDE) * _SIDE, _SIDE, _LANES, slots)


class Pixels(eqx.Module):
    """The points of the surface in front and of the one behind it, in tiles."""

    tiles: Float[Array, "tiles 3 points"]
    origin: Float[Array, "3"]
    """From which all points are seen here, mm."""
    farthest: Float[Array, "surfaces down across"]
    """Depth (mm) of the farthest point of each tile: what lies well behind it is not needed there."""
    view: AbstractView

    @classmethod
    def of(
        cls,
        points: Float[Array, "surfaces 3 height width"],
        covered: Bool[Array, "surfaces height width"],
        origin: Float[Array, "3"],
        view: AbstractView,
    ) -> "Pixels":
        depth = jnp.where(covered, view.project(stop_gradient(points).transpose(1, 0, 2, 3))[2], -jnp.inf)
        off = [(-view.height) % _SIDE, (-view.width) % _SIDE]
        padded = jnp.pad(depth, ((0, 0), (0, off[0]), (0, off[1])), constant_values=-jnp.inf)
        farthest = padded.reshape(2, padded.shape[1] // _SIDE, _SIDE, -1, _SIDE).max(axis=(2, 4))
        seen = points - origin[None, :, None, None]
        away = jnp.pad(jnp.where(covered[:, None], seen, FAR), ((0, 0), (0, 0), (0, off[0]), (0, 0)), constant_values=FAR)
        tiles = tile_grid(view.width, view.height, 1).cut(jnp.concatenate([away[0], away[1]], axis=1), FAR)
        return cls(tiles, origin, farthest, view)

    def bins(self, centers, there, reach: Float[Array, " sources"], block: int, slots: int, capacity: BinCapacity) -> Bins:
        """List for each tile the blocks of sources within reach (mm); for the surface behind their numbers go on."""
        grid = tile_grid(self.view.width, self.view.height, slots)
        centers, reach = stop_gradient(centers), stop_gradient(reach)
        ranges = block_ranges(centers + self.origin[:, None], there, reach, block, self.view, self.farthest)
        blocks, tiles = Boxes.around(centers, there, block), self.boxes
        farthest = jnp.max(jnp.where(there, reach, 0.0).reshape(-1, block), axis=1)

        def meet(item, tile):
            item = item % farthest.shape[0]

            def apart(axis):
                """Give how far the boxes lie apart along an axis."""
                gap = jnp.maximum(
                    tiles.low[axis][tile] - blocks.high[axis][item], blocks.low[axis][item] - tiles.high[axis][tile]
                )
                return jnp.maximum(gap, 0.0)

            return apart(0) ** 2 + apart(1) ** 2 + apart(2) ** 2 <= farthest[item] ** 2

        return bin_items(ranges, grid, capacity, meet)

    @property
    def boxes(self) -> Boxes:
        """Boxes around the points of every tile."""
        points = self.tiles.transpose(1, 0, 2).reshape(3, -1)
        return Boxes.around(points, points[0] != FAR, _SIDE**2)

    def steps(self, bins: Bins, blocks: int) -> Steps:
        sweeps = bins.places // bins.ids.shape[1]
        ids = jnp.where(bins.ids < 2 * blocks, bins.ids % blocks, blocks)
        return Steps(ids, bins.first_block[:sweeps], bins.first_block[1 : sweeps + 1], bins.order)

    def surfaces(self, tiles: Float[Array, "tiles rows points"]) -> Float[Array, "surfaces rows height width"]:
        """Put both pictures together from their tiles."""
        grid = tile_grid(self.view.width, self.view.height, 1)
        picture = grid.join(tiles)
        both = picture.reshape(picture.shape[0], 2, -1, picture.shape[2])[:, :, : self.view.height]
        return both.transpose(1, 0, 2, 3)


def block_ranges(
    centers: Float[Array, "3 sources"],
    there: Bool[Array, " sources"],
    reach: Float[Array, " sources"],
    block: int,
    view: AbstractView,
    farthest: Float[Array, "surfaces down across"],
) -> TileRanges:
    """Find the tiles of both surfaces within reach of any source of each block. Not differentiated."""
    reach = stop_gradient(reach)
    left, right, top, bottom, depth = view.sphere_box(centers, reach)

    def of_block(reduce, values, empty):
        return reduce(jnp.where(there, values, empty).reshape(-1, block), axis=1)

    left, top, near = (of_block(jnp.min, each, jnp.inf) for each in (left, top, depth - reach))
    right, bottom = (of_block(jnp.max, each, -jnp.inf) for each in (right, bottom))
    grid = TileGrid(view.width, view.height, _SIDE)
    ranges = TileRanges.of(left, right, top, bottom, jnp.any(there.reshape(-1, block), axis=1), grid)
    found = []
    for surface, far in enumerate(farthest):
        keep = near <= _farthest_in(ranges, far)
        down = jnp.where(keep, ranges.down, 0)
        found.append((ranges.left, ranges.top + surface * grid.down, ranges.across, down))
    return TileRanges(*(jnp.concatenate(each) for each in zip(*found, strict=True)))


def _farthest_in(ranges: TileRanges, far: Float[Array, "down across"]):
    """Give the maximum over each rectangle: the smallest power of two that spans it, four overlapping looks at that level."""
    span = jnp.maximum(ranges.across, ranges.down)
    pyramid, size = [far], 1
    while size < max(far.shape):
        last = pyramid[-1]
        shifted = jnp.pad(last, ((0, size), (0, size)), constant_values=-jnp.inf)
        h, w = last.shape
        pyramid.append(
            jnp.maximum(
                jnp.maximum(last, shifted[size : size + h, :w]), jnp.maximum(shifted[:h, size : size + w], shifted[size:, size:])
            )
        )
        size *= 2
    stack = jnp.stack(pyramid)  # level l: maximum over the 2^l tiles right of and below each
    level = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(span, 1).astype(jnp.float32))).astype(jnp.int32), 0, stack.shape[0] - 1)
    return stack[level, jnp.minimum(ranges.top, far.shape[0] - 1), jnp.minimum(ranges.left, far.shape[1] - 1)]
