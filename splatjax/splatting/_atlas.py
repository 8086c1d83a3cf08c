"""The tiles of a picture that show anything, packed: what works on pixels one by one need not look
at the others.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from splatjax._chunking import AT_ONCE, jit_unless_traced
from splatjax.devices import Devices

from ._bins import SIDE, TileGrid
from ._rasterizer import FragmentSums, SummedFragments
from ._views import AbstractView

Packed = TypeVar("Packed", bound=PyTree)

TILES_AT_ONCE = AT_ONCE // SIDE**2
"""For what is computed in parts."""


def farthest_depths(
    summed: SummedFragments, view: AbstractView
) -> Float[Array, "surfaces down across"]:
    """Give the depth (mm) of the farthest point that each tile shows, of both surfaces; -inf where
    a tile shows none.

    Where one shows behind, there is a front.
    """

    def farthest(sums: FragmentSums) -> Float[Array, " tiles"]:
        there = sums.weights > 0
        depth = view.depth(
            jnp.where(there, sums.nearness / jnp.where(there, sums.weights, 1.0), 1.0)
        )
        return stop_gradient(jnp.max(jnp.where(there, depth, -jnp.inf), axis=1))

    front, behind = farthest(summed.front), farthest(summed.behind)
    grid = TileGrid(view.width, view.height)
    return jnp.stack([jnp.maximum(front, behind), behind]).reshape(2, grid.down, grid.across)


class Atlas(eqx.Module):
    """The tiles of the front surface and of the one behind it that show anything, packed into a
    list of places.
    """

    view: AbstractView
    farthest: Float[Array, "surfaces down across"]
    tiles: Int[Array, " tiles"]
    """The tile at each place: those of the front row by row, then those behind; in an empty place
    the number of all.
    """
    places: Int[Array, " all"]
    """The place of every tile; the number of places for a tile that shows nothing."""
    needed: Float[Array, ""]
    """Tiles over places; what lies beyond is missing where this is above 1."""
    poison: Float[Array, ""]
    """Factor of every picture: 1, or NaN."""

    @classmethod
    @jit_unless_traced
    def of(
        cls, farthest: Float[Array, "surfaces down across"], view: AbstractView, room: int
    ) -> "Atlas":
        """Pack the tiles that show anything, as `farthest_depths` says, into `room` places."""
        shows = farthest.reshape(-1) > -jnp.inf
        tiles = jnp.nonzero(shows, size=room, fill_value=shows.shape[0])[0].astype(jnp.int32)
        places = (
            jnp.full(shows.shape[0], room, jnp.int32)
            .at[tiles]
            .set(jnp.arange(room, dtype=jnp.int32), mode="drop")
        )
        needed = jnp.sum(shows).astype(farthest.dtype) / room
        return cls(view, farthest, tiles, places, needed, jnp.ones_like(needed))

    def of_all(self, devices: Devices) -> "Atlas":
        """Give the atlas of the places of all devices, one after the other, each of which shows
        tiles of its own.
        """
        tiles = devices.everything(self.tiles)
        room = tiles.shape[0]
        places = (
            jnp.full(self.places.shape[0], room, jnp.int32)
            .at[tiles]
            .set(jnp.arange(room, dtype=jnp.int32), mode="drop")
        )
        farthest, needed = devices.largest((self.farthest, self.needed))
        return Atlas(self.view, farthest, tiles, places, needed, self.poison)

    def poisoned_unless(self, fits: Bool[Array, ""]) -> "Atlas":
        """Make every picture NaN, and its derivatives too, where a plan does not suffice."""
        poison = jnp.where(fits, self.poison, jnp.asarray(jnp.nan, self.poison.dtype))
        return eqx.tree_at(lambda atlas: atlas.poison, self, poison)

    @property
    def grid(self) -> TileGrid:
        """The tiles of one surface."""
        return TileGrid(self.view.width, self.view.height)

    @property
    def in_front(self):
        """Say which places hold tiles of the front surface."""
        return self.tiles < self.grid.count

    def pack(self, front: Packed, behind: Packed) -> Packed:
        """Put all tiles `[tiles, ...]` of both surfaces in their places, those that show nothing
        nowhere. Differentiable.
        """
        count = self.grid.count

        def packed(front: Array, behind: Array) -> Array:
            among_front = front.at[jnp.where(self.in_front, self.tiles, count)].get(
                mode="fill", fill_value=0
            )
            among_behind = behind.at[jnp.where(self.in_front, count, self.tiles - count)].get(
                mode="fill", fill_value=0
            )
            return among_front + among_behind

        return jax.tree.map(packed, front, behind)

    def shares(self, coverage: Float[Array, "tiles pixels"]) -> Float[Array, "tiles pixels"]:
        """Give the share of its pixel that each point covers, from its surface's coverage: behind,
        of what the front leaves.
        """
        before = self.places.at[
            jnp.where(self.in_front, self.places.shape[0], self.tiles - self.grid.count)
        ]
        before = before.get(mode="fill", fill_value=self.tiles.shape[0])
        return coverage * (1 - coverage.at[before].get(mode="fill", fill_value=0))

    def points(self, depth: Float[Array, "tiles pixels"]) -> Float[Array, "3 tiles pixels"]:
        """Give the points (mm) that the pixels see at a depth (mm). Differentiable."""
        x, y = self.grid.columns_and_rows(self.tiles % self.grid.count)
        return self.view.unproject(x.astype(depth.dtype) + 0.5, y.astype(depth.dtype) + 0.5, depth)

    def pixels(self) -> Int[Array, "tiles pixels"]:
        """Number the pixels, row by row; what lies beyond the picture has the number of the pixel
        next to it.
        """
        x, y = self.grid.columns_and_rows(self.tiles % self.grid.count)
        grid = self.grid
        return jnp.minimum(y, grid.height - 1) * grid.width + jnp.minimum(x, grid.width - 1)

    def front_picture(
        self, values: Float[Array, "tiles *rows pixels channels"], fill: float = 0.0
    ) -> Float[Array, "*rows height width channels"]:
        """Put the picture of the front surface together; `fill` where a tile shows nothing."""
        grid, (_, *rows, _, channels) = self.grid, values.shape
        tiles = self.poison * values.at[self.places[: grid.count]].get(mode="fill", fill_value=fill)
        tiles = tiles.reshape(grid.down, grid.across, *rows, SIDE, SIDE, channels)
        last = tiles.ndim - 3
        whole = tiles.transpose(*range(2, last), 0, last, 1, last + 1, last + 2)
        whole = whole.reshape(*rows, grid.down * SIDE, grid.across * SIDE, channels)
        return whole[..., : grid.height, : grid.width, :]

    def picture(
        self, values: Float[Array, "tiles *rows pixels channels"]
    ) -> Float[Array, "*rows height width channels"]:
        """Put the picture together to which both surfaces add."""
        behind = jnp.where(self.in_front, self.tiles + self.grid.count, self.places.shape[0])
        partner = self.places.at[behind].get(mode="fill", fill_value=self.tiles.shape[0])
        return self.front_picture(values + values.at[partner].get(mode="fill", fill_value=0))
