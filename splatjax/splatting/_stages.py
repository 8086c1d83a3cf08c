"""The sweeps of passes 2 and 3 one by one, for splats that are one part of many: another part's may
lie in front.

Depths are the largest nearness over all parts, and sums are sums: what one stage finds in all
parts, the next must know.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from splatjax._chunking import zeros_after

from ._bins import SIDE, Bins
from ._rasterizer import FragmentSums
from ._sweeps import Slots, Sweep, picked
from ._tiles import Binned


class Stages(eqx.Module):
    """One part's splats, binned, and what each stage finds of them, tile by tile."""

    sweep: Sweep
    bins: Bins
    slots: Slots

    @classmethod
    def of(cls, binned: Binned) -> "Stages":
        return cls(
            binned.sweep,
            binned.bins,
            Slots.gathered(binned.shift, binned.planes, binned.attributes, binned.bins),
        )

    @property
    def _count(self) -> int:
        return self.sweep.grid.count

    def _tiles(self, i):
        lanes = self.sweep.grid.lanes
        return lax.dynamic_slice_in_dim(self.bins.order, i * lanes, lanes)

    def _by_chunk(self, found, rows: tuple[int, ...], fill: float):
        """Put together what is found of every chunk, tile by tile; `fill` where there is no
        list.
        """
        dtype, lanes = self.slots.shift.dtype, self.sweep.grid.lanes

        def chunk(i, out):
            part = found(self.sweep.chunk(self.bins, i, dtype), self._tiles(i))
            return lax.dynamic_update_slice_in_dim(out, part, i * lanes, 0)

        empty = fill + zeros_after(self.slots.shift, (self.bins.places, *rows, SIDE**2), dtype)
        return self.bins.by_tile(
            lax.fori_loop(jnp.int32(0), self.bins.chunks, chunk, empty), self._count, fill
        )

    def _open(self, tiles: Bool[Array, " tiles"]):
        return picked(
            of_tiles(tiles, self.bins.order[: self.bins.places], False), self.sweep.grid.lanes
        )

    def _within(self, sums: Float[Array, "tiles rows pixels"]) -> FragmentSums:
        """What of a tile lies beyond the picture shows nothing; all is NaN where the lists lack
        room.
        """
        within = self.sweep.grid.within_picture()
        poison = self.bins.poison(sums.dtype)
        return FragmentSums.of(
            poison
            + (sums if within is None else jnp.where(jnp.asarray(within)[:, None], sums, 0.0))
        )

    def limits(self) -> Float[Array, "tiles pixels"]:
        """Stage 1: where the front ends, -inf where there is none; of several parts, the
        largest.
        """
        return self._by_chunk(lambda lanes, _: self.sweep.limits(self.slots, lanes), (), -jnp.inf)

    def front(self, limits: Float[Array, "tiles pixels"]) -> FragmentSums:
        """Stage 2: the sums of the front; of several parts, their sum."""

        def sums(lanes, tiles):
            return self.sweep.sums(self.slots, lanes, of_tiles(limits, tiles, jnp.inf), None)

        return self._within(self._by_chunk(sums, (len(self.slots.attributes) + 2,), 0.0))

    def limits_behind(
        self, limits: Float[Array, "tiles pixels"], gaps: Bool[Array, "tiles pixels"]
    ):
        """Stage 3: where what lies behind ends, of the fragments that weigh something and of any;
        the largest of each.
        """
        pick, rounds = self._open(jnp.any(gaps, axis=1))

        def look(i, out):
            places, real = pick(i)
            lanes, tiles = (
                self.sweep.picked(self.bins, places, limits.dtype),
                self.bins.order[places],
            )
            open_to = jnp.where(
                of_tiles(gaps, tiles, False) & real, of_tiles(limits, tiles, -jnp.inf), -jnp.inf
            )
            found = self.sweep.limits_behind(self.slots, lanes, open_to)
            return jax.tree.map(
                lambda whole, part: whole.at[tiles].max(part, mode="drop"), out, found
            )

        nothing = zeros_after(rounds, limits.shape, limits.dtype) - jnp.inf
        return lax.fori_loop(jnp.int32(0), rounds, look, (nothing, nothing))

    def behind(
        self, limits: Float[Array, "tiles pixels"], seconds: Float[Array, "tiles pixels"]
    ) -> FragmentSums:
        """Stage 4: the sums of what lies behind; `seconds` is inf where that is nothing."""
        pick, rounds = self._open(jnp.any(seconds < jnp.inf, axis=1))

        def look(i, out):
            places, real = pick(i)
            lanes, tiles = (
                self.sweep.picked(self.bins, places, limits.dtype),
                self.bins.order[places],
            )
            beyond = jnp.where(real, of_tiles(seconds, tiles, jnp.inf), jnp.inf)
            found = self.sweep.sums(self.slots, lanes, beyond, of_tiles(limits, tiles, jnp.inf))
            return out.at[tiles].add(found, mode="drop")

        nothing = zeros_after(
            rounds, (self._count, len(self.slots.attributes) + 2, SIDE**2), limits.dtype
        )
        return self._within(lax.fori_loop(jnp.int32(0), rounds, look, nothing))


def gaps(
    limits: Float[Array, "tiles pixels"],
    weights: Float[Array, "tiles pixels"],
    full_coverage: float,
) -> Bool[Array, "tiles pixels"]:
    """Say which pixels the front leaves open, by where it ends and what it weighs in all parts."""
    return (weights < full_coverage) & (limits > -jnp.inf)


def of_tiles(whole: Array, tiles: Array, fill) -> Array:
    """Take what belongs to some tiles; `fill` for those beyond the picture."""
    return whole.at[tiles].get(mode="fill", fill_value=fill)
