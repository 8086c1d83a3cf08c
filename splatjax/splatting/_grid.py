"""A picture divided into tiles, and the tiles that rectangles touch."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import divided

TILE_SIDE = 8  # pixels
_HALF = 128
TILE_BITS = 22  # bits for the number of a tile, in a sort key of 32 bits


class TileGrid(eqx.Module):
    """A picture divided into square tiles, row by row; the last ones may extend beyond it."""

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)

    def __check_init__(self):
        if self.padded_count >= 1 << TILE_BITS:
            raise ValueError(
                f"a picture of {self.width} x {self.height} pixels takes {self.padded_count} "
                f"tiles, and fewer than {1 << TILE_BITS} can be sorted; render fewer pixels"
            )

    @property
    def across(self) -> int:
        return -(-self.width // TILE_SIDE)

    @property
    def down(self) -> int:
        return -(-self.height // TILE_SIDE)

    @property
    def count(self) -> int:
        """Tiles of the picture."""
        return self.across * self.down

    @property
    def padded_count(self) -> int:
        """Tiles of the picture, and a few empty ones that fill the last chunk."""
        return -(-self.count // self.lanes) * self.lanes

    @property
    def half(self) -> int:
        """Chunks of half of the picture, or of 1024 x 1024 pixels if it is larger. Capacities are
        planned in parts of this number, so that many bodies share a program.
        """
        return min(-(-self.padded_count // (2 * self.lanes)), _HALF)

    def blocks(self, counts: Int[Array, "*tiles"]) -> Int[Array, "*tiles"]:
        """Count the blocks of lists of so many items."""
        return divided(counts + (self.slots - 1), self.slots)[0]

    def cut(self, picture: Float[Array, "rows height width"]) -> Float[Array, "tiles rows pixels"]:
        """Divide a picture into tiles; 0 beyond its edges."""
        rows, height, width = picture.shape
        padded = jnp.pad(
            picture,
            ((0, 0), (0, self.down * TILE_SIDE - height), (0, self.across * TILE_SIDE - width)),
        )
        return (
            padded.reshape(rows, self.down, TILE_SIDE, self.across, TILE_SIDE)
            .transpose(1, 3, 0, 2, 4)
            .reshape(self.count, rows, TILE_SIDE**2)
        )

    def join(self, tiles: Float[Array, "tiles rows pixels"]) -> Float[Array, "rows height width"]:
        """Join the tiles of a picture."""
        rows = tiles.shape[1]
        padded = tiles.reshape(self.down, self.across, rows, TILE_SIDE, TILE_SIDE).transpose(
            2, 0, 3, 1, 4
        )
        return padded.reshape(rows, self.down * TILE_SIDE, self.across * TILE_SIDE)[
            :, : self.height, : self.width
        ]

    def columns_and_rows(
        self, tiles: Int[Array, " some"]
    ) -> tuple[Int[Array, "some pixels"], Int[Array, "some pixels"]]:
        """Return the column and the row of every pixel of some tiles."""
        down, across = divided(tiles, self.across)
        y, x = divided(jnp.arange(TILE_SIDE**2, dtype=jnp.int32), TILE_SIDE)
        return (across * TILE_SIDE)[:, None] + x[None], (down * TILE_SIDE)[:, None] + y[None]

    def pixel(self, x: Int[Array, "..."], y: Int[Array, "..."]) -> Int[Array, "..."]:
        """Return the number of a pixel among those of all tiles, tile by tile."""
        (across, x), (down, y) = divided(x, TILE_SIDE), divided(y, TILE_SIDE)
        return (down * self.across + across) * TILE_SIDE**2 + y * TILE_SIDE + x

    def within_picture(self, tiles: Int[Array, " some"]) -> Bool[Array, "some pixels"]:
        """Mark the pixels of some tiles that are inside the picture."""
        x, y = self.columns_and_rows(tiles)
        return (x < self.width) & (y < self.height)


class TileRanges(eqx.Module):
    """The rectangle of tiles that each item touches; `down` is 0 for an item that touches none."""

    left: Int[Array, " items"]
    top: Int[Array, " items"]
    across: Int[Array, " items"]
    down: Int[Array, " items"]

    @classmethod
    def of(
        cls,
        box: tuple[Float[Array, " items"], ...],
        visible: Bool[Array, " items"],
        grid: TileGrid,
    ) -> "TileRanges":
        """Find the tiles with a pixel center inside each box: left, right, top and bottom, pixels.

        The last pixel is before the first where there is none.
        """
        left, right, top, bottom = box
        i0, j0 = (
            jnp.clip(jnp.ceil(edge - 0.5), 0, count) / TILE_SIDE
            for edge, count in ((left, grid.width), (top, grid.height))
        )
        i1, j1 = (
            jnp.clip(jnp.floor(edge - 0.5), -1, count - 1) / TILE_SIDE
            for edge, count in ((right, grid.width), (bottom, grid.height))
        )
        touched = visible & (i0 <= i1) & (j0 <= j1)
        i0, i1, j0, j1 = (jnp.floor(edge).astype(jnp.int32) for edge in (i0, i1, j0, j1))
        return cls(i0, j0, jnp.where(touched, i1 - i0 + 1, 0), jnp.where(touched, j1 - j0 + 1, 0))

    def per_tile(self, grid: TileGrid) -> Int[Array, " tiles"]:
        """Count the items of every tile, from the corners of their rectangles."""
        touched = jnp.where(self.across * self.down > 0, 1, 0)
        corners = jnp.zeros((grid.down + 1, grid.across + 1), jnp.int32)
        right, below = self.left + self.across, self.top + self.down
        corners = corners.at[self.top, self.left].add(touched).at[below, right].add(touched)
        corners = corners.at[self.top, right].add(-touched).at[below, self.left].add(-touched)
        counts = jnp.cumsum(jnp.cumsum(corners, axis=0), axis=1)[:-1, :-1].reshape(-1)
        return jnp.pad(counts, (0, grid.padded_count - counts.shape[0]))
