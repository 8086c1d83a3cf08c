"""The points that pixels see, in tiles, and what lies near each tile."""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax.devices import Devices
from splatjax.splatting import (
    SIDE,
    AbstractView,
    Atlas,
    BinCapacity,
    Bins,
    TileGrid,
    TileRanges,
    bin_items,
)

from ._gaussian_sums import Steps
from ._neighbors import Boxes

FAR = -1e6  # mm from anything, yet with a square that float32 holds
_LANES = 32


def tile_grid(width: int, height: int, slots: int) -> TileGrid:
    """The tiles of two surfaces of a picture, one below the other."""
    return TileGrid(width, 2 * -(-height // SIDE) * SIDE, _LANES, slots)


class Pixels(eqx.Module):
    """The points of the surface in front and of the one behind it, in the tiles of an atlas."""

    tiles: Float[Array, "tiles_and_one 3 points"]
    """The last shows nothing: it stands for every tile that is not in the atlas."""
    origin: Float[Array, "3"]
    """From which all points are seen here, mm."""
    atlas: Atlas

    @classmethod
    def of(
        cls,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        origin: Float[Array, "3"],
        atlas: Atlas,
    ) -> "Pixels":
        seen = jnp.where(covered[:, None], points - origin[None, :, None], FAR)
        return cls(jnp.pad(seen, ((0, 1), (0, 0), (0, 0)), constant_values=FAR), origin, atlas)

    def of_all(self, devices: Devices) -> "Pixels":
        """Give the points of all devices: each has its own share."""
        tiles = devices.everything(self.tiles[:-1])
        return Pixels(
            jnp.pad(tiles, ((0, 1), (0, 0), (0, 0)), constant_values=FAR),
            self.origin,
            self.atlas.of_all(devices),
        )

    def bins(
        self,
        centers,
        there,
        reach: Float[Array, " sources"],
        block: int,
        slots: int,
        capacity: BinCapacity,
    ) -> Bins:
        """List for each tile the blocks of sources within reach (mm); for the surface behind their
        numbers go on.
        """
        view = self.atlas.view
        grid = tile_grid(view.width, view.height, slots)
        centers, reach = stop_gradient(centers), stop_gradient(reach)
        ranges = block_ranges(
            centers + self.origin[:, None], there, reach, block, view, self.atlas.farthest
        )
        blocks, tiles = Boxes.around(centers, there, block), self.boxes
        farthest = jnp.max(jnp.where(there, reach, 0.0).reshape(-1, block), axis=1)
        places = self._places(grid)

        (tile_low, tile_high), (low, high) = ((each.low.T, each.high.T) for each in (tiles, blocks))

        def meet(item, tile):
            item, place = item % farthest.shape[0], places[tile]
            # in one expression, so that it is one loop over the pairs
            gaps = jnp.maximum(tile_low[place] - high[item], low[item] - tile_high[place])
            return jnp.sum(jnp.maximum(gaps, 0.0) ** 2, axis=1) <= farthest[item] ** 2

        return bin_items(ranges, grid, capacity, meet)

    def _places(self, grid: TileGrid) -> Int[Array, " tiles"]:
        places = self.atlas.places
        return jnp.pad(
            places, (0, grid.tiles - places.shape[0]), constant_values=self.tiles.shape[0] - 1
        )

    @property
    def chunks(self) -> int:
        """How many chunks of tiles there may be with anything in them."""
        grid = tile_grid(self.atlas.view.width, self.atlas.view.height, 1)
        return grid.tiles // grid.lanes

    @property
    def boxes(self) -> Boxes:
        """Boxes around the points of every tile."""
        points = self.tiles.transpose(1, 0, 2).reshape(3, -1)
        return Boxes.around(points, points[0] != FAR, SIDE**2)

    def steps(self, bins: Bins, blocks: int) -> Steps:
        lanes = bins.ids.shape[1]
        sweeps = bins.places // lanes
        ids = jnp.where(bins.ids < 2 * blocks, bins.ids % blocks, blocks)
        places = self._places(tile_grid(self.atlas.view.width, self.atlas.view.height, 1))
        return Steps(
            ids,
            bins.first_block[:sweeps],
            bins.first_block[1 : sweeps + 1],
            places[bins.order[: sweeps * lanes]],
        )


def block_ranges(
    centers: Float[Array, "3 sources"],
    there: Bool[Array, " sources"],
    reach: Float[Array, " sources"],
    block: int,
    view: AbstractView,
    farthest: Float[Array, "surfaces down across"],
) -> TileRanges:
    """Find the tiles of both surfaces within reach of any source of each block. Not
    differentiated.
    """
    reach = stop_gradient(reach)
    left, right, top, bottom, depth = view.sphere_box(centers, reach)

    def of_block(reduce, values, empty):
        return reduce(jnp.where(there, values, empty).reshape(-1, block), axis=1)

    left, top, near = (of_block(jnp.min, each, jnp.inf) for each in (left, top, depth - reach))
    right, bottom = (of_block(jnp.max, each, -jnp.inf) for each in (right, bottom))
    grid = TileGrid(view.width, view.height)
    ranges = TileRanges.of(
        left, right, top, bottom, jnp.any(there.reshape(-1, block), axis=1), grid
    )
    found = []
    for surface, far in enumerate(farthest):
        keep = near <= _farthest_in(ranges, far)
        down = jnp.where(keep, ranges.down, 0)
        found.append((ranges.left, ranges.top + surface * grid.down, ranges.across, down))
    return TileRanges(*(jnp.concatenate(each) for each in zip(*found, strict=True)))


def _farthest_in(ranges: TileRanges, far: Float[Array, "down across"]):
    """Give at least the maximum over each rectangle: that over the smallest square of a power of
    two that spans it.
    """
    span = jnp.maximum(ranges.across, ranges.down)
    pyramid, size = [far], 1
    while size < max(far.shape):
        last = pyramid[-1]
        shifted = jnp.pad(last, ((0, size), (0, size)), constant_values=-jnp.inf)
        h, w = last.shape
        pyramid.append(
            jnp.maximum(
                jnp.maximum(last, shifted[size : size + h, :w]),
                jnp.maximum(shifted[:h, size : size + w], shifted[size:, size:]),
            )
        )
        size *= 2
    stack = jnp.stack(pyramid)  # level l: maximum over the 2^l tiles right of and below each
    level = jnp.clip(
        jnp.ceil(jnp.log2(jnp.maximum(span, 1).astype(jnp.float32))).astype(jnp.int32),
        0,
        stack.shape[0] - 1,
    )
    return stack[
        level, jnp.minimum(ranges.top, far.shape[0] - 1), jnp.minimum(ranges.left, far.shape[1] - 1)
    ]
