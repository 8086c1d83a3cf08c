"""Passes 2 and 3 tile by tile: fragments are summed per pixel, with a derivative that recomputes
the weights.

A tile is swept twice: for the depth at which the front ends, then for its sums. Tiles with a pixel
that the front leaves open are swept twice more for the surface behind. On one device both sweeps of
a chunk of tiles follow each other, while its splats are in the cache; of several parts of the
splats, each stage must know what the one before found in all parts. The backward sweep needs only
the depths at which the surfaces end.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced, zeros_after
from splatjax._combination import AbstractCombination, OneDevice

from ._bins import Bins, scatter_slots
from ._fragments import Slots, Sweep, second_limits
from ._grid import SIDE
from ._rasterizer import FragmentSums, Places


class Ends(eqx.Module):
    """Where the fragments of each place begin and end, and which lanes of the bins they are in.

    **Attributes:**

    - `beyond`: fragments count that are nearer than this; inf where there are none.
    - `upto`: behind the front, fragments count that are not nearer than this.
    - `places`: the place of each lane of the bins; the number of places for a lane without one.
    - `lanes`: the lane of each place of the surface behind; the number of lanes for none.
    """

    beyond: Float[Array, "places pixels"]
    upto: Float[Array, "behind pixels"]
    places: Int[Array, " lanes"]
    lanes: Int[Array, " behind"]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def sum_fragments(
    sweep: Sweep,
    capacity: Places,
    combination: AbstractCombination,
    bins: Bins,
    shift: Float[Array, " splats"],
    planes: tuple[Float[Array, " splats"], ...],
    attributes: Float[Array, "splats attributes"],
) -> FragmentSums:
    """Sum attributes over the splats of every tile: this device's part of the sums."""
    return _forward(sweep, capacity, combination, bins, shift, planes, attributes)[0]


def _forward(sweep, capacity, combination, bins, shift, planes, attributes):
    slots = Slots.gathered(shift, planes, attributes, bins)
    if isinstance(combination, OneDevice):
        return _sum_chunks(sweep, capacity, bins, slots)
    stages = PartSweep(sweep, bins, slots)
    (found,) = sum_parts(lambda: [[stages]], [capacity], combination)
    return found


def _sum_fwd(sweep, capacity, combination, bins, shift, planes, attributes):
    sums, ends = _forward(sweep, capacity, combination, bins, shift, planes, attributes)
    return sums, (bins, shift, planes, attributes, ends)


def _sum_bwd(sweep: Sweep, capacity: Places, combination, residuals, cotangent):
    bins, shift, planes, attributes, ends = residuals
    slots, lanes = Slots.gathered(shift, planes, attributes, bins), sweep.grid.lanes
    dtype, splats = shift.dtype, shift.shape[0]
    cotangent = cotangent.rows

    def front(i, gradients):
        places = lax.dynamic_slice_in_dim(ends.places, i * lanes, lanes)
        beyond = ends.beyond.at[places].get(mode="fill", fill_value=jnp.inf)
        own = cotangent.at[places].get(mode="fill", fill_value=0)
        chunk = sweep.chunk(bins, i, dtype)
        return sweep.add_cotangents(slots, chunk, beyond, None, own, gradients)

    def behind(i, gradients):
        picked, exists = _pick(ends.lanes, i, lanes, bins)
        beyond, own = (
            lax.dynamic_slice_in_dim(each, capacity.front + i * lanes, lanes)
            for each in (ends.beyond, cotangent)
        )
        beyond = jnp.where(exists, beyond, jnp.inf)
        upto = lax.dynamic_slice_in_dim(ends.upto, i * lanes, lanes)
        picked = sweep.picked(bins, picked, dtype)
        return sweep.add_cotangents(slots, picked, beyond, upto, own, gradients)

    of_planes = tuple(zeros_after(cotangent, slots.shift.shape, dtype) for _ in planes)
    gradients = of_planes, zeros_after(cotangent, attributes.shape, dtype)
    gradients = lax.fori_loop(jnp.int32(0), bins.chunks, front, gradients)
    rounds = _rounds(jnp.any(ends.beyond[capacity.front :] < jnp.inf, axis=1), lanes)
    of_planes, of_rows = lax.fori_loop(jnp.int32(0), rounds, behind, gradients)
    return None, None, tuple(scatter_slots(each, bins, splats) for each in of_planes), of_rows


sum_fragments.defvjp(_sum_fwd, _sum_bwd)


def _sum_chunks(
    sweep: Sweep, capacity: Places, bins: Bins, slots: Slots
) -> tuple[FragmentSums, Ends]:
    """Sweep all chunks of tiles; places are lanes."""
    grid, dtype, lanes = sweep.grid, slots.shift.dtype, sweep.grid.lanes
    count = capacity.front + capacity.behind

    def write(whole, part, i):
        return lax.dynamic_update_slice_in_dim(whole, part, i, 0)

    # The front, chunk by chunk.
    def chunk(i, out):
        rows, beyond = out
        tiles = sweep.chunk(bins, i, dtype)
        limits = sweep.limits(slots, tiles)
        own = lax.dynamic_slice_in_dim(bins.order, i * lanes, lanes)
        sums = sweep.within_picture(sweep.sums(slots, tiles, limits, None), own)
        return write(rows, sums, i * lanes), write(beyond, limits, i * lanes)

    rows = zeros_after(slots.shift, (count, slots.attributes.shape[1] + 2, SIDE**2), dtype)
    beyond = jnp.inf + zeros_after(slots.shift, (count, SIDE**2), dtype)
    rows, beyond = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, (rows, beyond))

    # The surface behind, where the front leaves a pixel open.
    front = beyond[: capacity.front]
    gaps = (rows[: capacity.front, -1] < sweep.full_coverage) & (jnp.abs(front) < jnp.inf)
    is_open = jnp.any(gaps, axis=1)
    (picks,) = jnp.nonzero(is_open, size=capacity.behind, fill_value=capacity.front)
    picks = picks.astype(jnp.int32)

    def look_behind(i, out):
        rows, beyond, upto = out
        picked, exists = _pick(picks, i, lanes, bins)
        tiles, limits = sweep.picked(bins, picked, dtype), front[picked]
        open_to = jnp.where(gaps[picked] & exists, limits, -jnp.inf)
        seconds = second_limits(*sweep.limits_behind(slots, tiles, open_to))
        sums = sweep.sums(slots, tiles, seconds, limits)
        sums = sweep.within_picture(sums, bins.order[picked])
        here = capacity.front + i * lanes
        return write(rows, sums, here), write(beyond, seconds, here), write(upto, limits, i * lanes)

    upto = zeros_after(picks, (capacity.behind, SIDE**2), dtype)
    rounds = _rounds(picks < capacity.front, lanes)
    rows, beyond, upto = lax.fori_loop(jnp.int32(0), rounds, look_behind, (rows, beyond, upto))
    order = jnp.minimum(jnp.append(bins.order, grid.count), grid.count)
    own = jnp.arange(capacity.front, dtype=jnp.int32)
    tiles = order[jnp.concatenate([own, jnp.where(picks < capacity.front, picks, len(order) - 1)])]
    needed = jnp.sum(is_open).astype(dtype) / capacity.behind
    needed = jnp.maximum(bins.needed.astype(dtype), needed)
    return FragmentSums(tiles, rows, needed, capacity.front), Ends(beyond, upto, own, picks)


class PartSweep(eqx.Module):
    """The stages of the sweep one by one, for splats that are one part of many: the splats of
    another part may lie in front.
    """

    sweep: Sweep
    bins: Bins
    slots: Slots

    @jit_unless_traced
    def limits(self) -> Float[Array, "tiles pixels"]:
        """Find where the front ends, -inf where there is none."""
        lanes, dtype = self.sweep.grid.lanes, self.slots.shift.dtype

        def chunk(i, limits):
            found = self.sweep.limits(self.slots, self.sweep.chunk(self.bins, i, dtype))
            tiles = lax.dynamic_slice_in_dim(self.bins.order, i * lanes, lanes)
            return limits.at[tiles].set(found, mode="drop")

        limits = zeros_after(self.slots.shift, (self.sweep.grid.count, SIDE**2), dtype) - jnp.inf
        return lax.fori_loop(jnp.int32(0), self.bins.chunks, chunk, limits)

    @jit_unless_traced
    def sums(
        self,
        tiles: Int[Array, " places"],
        beyond: Float[Array, "places pixels"],
        upto: Float[Array, "places pixels"] | None,
    ) -> Float[Array, "places rows pixels"]:
        """Sum over the fragments between two depths in the pixels of some tiles."""

        def add(chunk, lanes, i):
            farther = None if upto is None else _round_of(upto, i, self.sweep)
            sums = self.sweep.sums(self.slots, chunk, _round_of(beyond, i, self.sweep), farther)
            return self.sweep.within_picture(sums, self.bins.order[lanes])

        rows = self.slots.attributes.shape[1] + 2
        nothing = zeros_after(beyond, (len(tiles), rows, SIDE**2), beyond.dtype)
        return self._each_round(tiles, add, nothing)

    @jit_unless_traced
    def limits_behind(
        self, tiles: Int[Array, " places"], open_to: Float[Array, "places pixels"]
    ) -> tuple[Float[Array, "places pixels"], Float[Array, "places pixels"]]:
        """Find where the surface behind ends, of the fragments of some weight and of any; `open_to`
        is where the front ends in open pixels, -inf in others.
        """

        def look(chunk, lanes, i):
            return self.sweep.limits_behind(self.slots, chunk, _round_of(open_to, i, self.sweep))

        nothing = zeros_after(open_to, open_to.shape, open_to.dtype) - jnp.inf
        return self._each_round(tiles, look, (nothing, nothing))

    def lanes(self, tiles: Int[Array, " places"]) -> Int[Array, " places"]:
        """Return the lane of each tile in the bins; the number of lanes for none."""
        swept = self.bins.lanes
        lane = jnp.full(self.sweep.grid.tiles + 1, swept, jnp.int32)
        lane = lane.at[self.bins.order[:swept]].set(jnp.arange(swept, dtype=jnp.int32))
        return lane[jnp.where(tiles < self.sweep.grid.count, tiles, len(lane) - 1)]

    def _each_round(self, tiles: Int[Array, " places"], function: Callable, start):
        """Write what a function finds of so many places at a time as there are lanes."""
        lanes, count = self.lanes(tiles), self.sweep.grid.lanes
        dtype = self.slots.shift.dtype

        def step(i, out):
            own, exists = _pick(lanes, i, count, self.bins)
            found = function(self.sweep.picked(self.bins, own, dtype), own, i)

            def write(whole, part):
                kept = exists.reshape(-1, *[1] * (part.ndim - 1))
                part = jnp.where(kept, part, lax.dynamic_slice_in_dim(whole, i * count, count))
                return lax.dynamic_update_slice_in_dim(whole, part, i * count, 0)

            return jax.tree.map(write, out, found)

        return lax.fori_loop(jnp.int32(0), len(tiles) // count, step, start)


def sum_parts(
    parts: Callable[[], Iterable[Sequence[PartSweep]]],
    capacities: Sequence[Places],
    combination: AbstractCombination,
) -> list[tuple[FragmentSums, Ends]]:
    """Sum the fragments of splats that are several parts, in several views at once.

    **Arguments:**

    - `parts`: iterates over the parts on this device whenever it is called; of each, the sweep of
      every view.
    - `capacities`: of each view.

    **Returns:** for each view the sums on this device, and where they end.
    """
    views = range(len(capacities))
    first = next(iter(parts()))
    grids = [each.sweep.grid for each in first]
    full_coverage = [each.sweep.full_coverage for each in first]
    # Stage 1: where the front ends in any part.
    limits = combination.largest([each.limits() for each in part] for part in parts())
    shown = [jnp.any(each > -jnp.inf, axis=1) for each in limits]
    fronts = [_listed(shown[k], capacities[k].front) for k in views]
    nearer = [_at_tiles(limits[k], fronts[k], jnp.inf) for k in views]
    nearer = [jnp.where(each > -jnp.inf, each, jnp.inf) for each in nearer]
    # Stage 2: the sums of the front.
    front = combination.own_total(
        [each.sums(fronts[k], nearer[k], None) for k, each in enumerate(part)] for part in parts()
    )
    weights = combination.total([[rows[:, -1] for rows in front]])
    # Stage 3: where the surface behind ends, in pixels that the front leaves open.
    gaps = [(weights[k] < full_coverage[k]) & (nearer[k] < jnp.inf) for k in views]
    is_open = [jnp.any(each, axis=1) for each in gaps]
    picks = [_listed(is_open[k], capacities[k].behind) for k in views]
    behind = [_at_tiles(fronts[k], picks[k], grids[k].count) for k in views]
    upto = [_at_tiles(nearer[k], picks[k], -jnp.inf) for k in views]
    open_to = [jnp.where(_at_tiles(gaps[k], picks[k], False), upto[k], -jnp.inf) for k in views]
    both = combination.largest(
        [each.limits_behind(behind[k], open_to[k]) for k, each in enumerate(part)]
        for part in parts()
    )
    seconds = [second_limits(*each) for each in both]
    # Stage 4: the sums of the surface behind.
    rest = combination.own_total(
        [each.sums(behind[k], seconds[k], upto[k]) for k, each in enumerate(part)]
        for part in parts()
    )
    found = []
    for k, capacity in enumerate(capacities):
        counts = jnp.sum(shown[k]) / capacity.front, jnp.sum(is_open[k]) / capacity.behind
        needed = jnp.maximum(*counts).astype(weights[k].dtype)
        needed = combination.largest(
            [jnp.maximum(first[k].bins.needed.astype(needed.dtype), needed)]
        )
        tiles = jnp.concatenate([fronts[k], behind[k]])
        sums = FragmentSums(tiles, jnp.concatenate([front[k], rest[k]]), needed, capacity.front)
        places = jnp.full(grids[k].tiles, len(tiles), jnp.int32)
        places = places.at[fronts[k]].set(jnp.arange(capacity.front, dtype=jnp.int32), mode="drop")
        beyond = jnp.concatenate([nearer[k], seconds[k]])
        own = Ends(beyond, upto[k], places[first[k].bins.order], first[k].lanes(behind[k]))
        found.append((sums, own))
    return found


def _listed(chosen: Bool[Array, " all"], size: int) -> Int[Array, " size"]:
    """List the indices of the chosen ones; their number for empty places."""
    return jnp.nonzero(chosen, size=size, fill_value=len(chosen))[0].astype(jnp.int32)


def _at_tiles(whole: Array, tiles: Int[Array, " places"], fill) -> Array:
    return whole.at[tiles].get(mode="fill", fill_value=fill)


def _round_of(rows: Array, i, sweep: Sweep) -> Array:
    return lax.dynamic_slice_in_dim(rows, i * sweep.grid.lanes, sweep.grid.lanes)


def _pick(lanes: Int[Array, " places"], i, count: int, bins: Bins):
    """Return the lanes of one round, and `[lanes, 1]` which exist; others are the last one."""
    picked = lax.dynamic_slice_in_dim(lanes, i * count, count)
    exists = picked < bins.lanes
    return jnp.where(exists, picked, bins.lanes - 1), exists[:, None]


def _rounds(chosen: Bool[Array, " places"], lanes: int) -> Int[Array, ""]:
    """Count the rounds of so many lanes that visit all places up to the last chosen one."""
    last = jnp.max(jnp.where(chosen, jnp.arange(1, len(chosen) + 1, dtype=jnp.int32), 0), initial=0)
    return -(-last // lanes)
