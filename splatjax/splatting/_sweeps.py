"""Passes 2 and 3 tile by tile: fragments are summed per pixel, with a derivative that recomputes
the weights.

A tile is swept twice: for the depth at which the front ends, then for its sums. Tiles with a pixel
that the front leaves open are swept twice more for the surface behind. Each of these stages must
know what the one before found in all parts of the splats. The backward sweep needs only the depths
at which the surfaces end.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced, zeros_after
from splatjax._combination import AbstractCombination

from ._bins import Bins, scatter_slots
from ._fragments import Lanes, Slots, Sweep, second_limits
from ._grid import SIDE
from ._rasterizer import FragmentSums, Places


class Spans(eqx.Module):
    """Which fragments are summed, in the pixels of some tiles: those between two depths.

    **Attributes:**

    - `tiles`: the tile at each place; the number of tiles for none.
    - `beyond`: fragments count that are nearer than this; inf where there are none.
    - `upto`: fragments count that are not nearer than this.
    """

    tiles: Int[Array, " places"]
    beyond: Float[Array, "places pixels"]
    upto: Float[Array, "places pixels"]


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
    return _sum_fwd(sweep, capacity, combination, bins, shift, planes, attributes)[0]


def _sum_fwd(sweep, capacity, combination, bins, shift, planes, attributes):
    part = PartSweep(sweep, bins, Slots.gathered(shift, planes, attributes, bins))
    ((sums, spans),) = sum_parts(lambda: [[part]], [capacity], combination)
    return sums, (bins, shift, planes, attributes, spans)


def _sum_bwd(sweep: Sweep, capacity: Places, combination, residuals, cotangent):
    bins, shift, planes, attributes, spans = residuals
    part = PartSweep(sweep, bins, Slots.gathered(shift, planes, attributes, bins))
    dtype, cotangent = shift.dtype, cotangent.rows

    def add(_, lanes: Lanes, beyond, upto, rows, gradients):
        return sweep.add_cotangents(part.slots, lanes, beyond, upto, rows, gradients)

    of_planes = tuple(zeros_after(cotangent, part.slots.shift.shape, dtype) for _ in planes)
    gradients = of_planes, zeros_after(cotangent, attributes.shape, dtype)
    given = spans.beyond, spans.upto, cotangent
    of_planes, of_rows = part.each_round(spans.tiles, given, add, gradients)
    slots = (scatter_slots(each, bins, shift.shape[0]) for each in of_planes)
    return None, None, tuple(slots), of_rows


sum_fragments.defvjp(_sum_fwd, _sum_bwd)


class PartSweep(eqx.Module):
    """The stages of the sweep one by one, for splats that may be one part of many: the splats of
    another part may lie in front.
    """

    sweep: Sweep
    bins: Bins
    slots: Slots

    @jit_unless_traced
    def limits(self) -> tuple[Float[Array, "tiles pixels"], Int[Array, " tiles"]]:
        """Find where the front ends, -inf where there is none; and the length of each list."""
        grid, order, dtype = self.sweep.grid, self.bins.order, self.slots.shift.dtype

        def chunk(i, limits):
            own = i * grid.lanes + jnp.arange(grid.lanes, dtype=jnp.int32)
            found = self.sweep.limits(self.slots, self.sweep.lanes(self.bins, own, dtype))
            return limits.at[order[own]].set(found, mode="drop")

        limits = zeros_after(self.slots.shift, (grid.count, SIDE**2), dtype) - jnp.inf
        limits = lax.fori_loop(jnp.int32(0), self.bins.chunks, chunk, limits)
        lengths = jnp.repeat(jnp.diff(self.bins.first_block), grid.lanes)
        return limits, jnp.zeros(grid.count, jnp.int32).at[order].set(lengths, mode="drop")

    @jit_unless_traced
    def sums(self, spans: Spans) -> Float[Array, "places rows pixels"]:
        """Sum over the fragments of some spans."""

        def add(i, lanes: Lanes, beyond, upto, tiles, out):
            sums = self.sweep.sums(self.slots, lanes, beyond, upto)
            return _write(out, self.sweep.within_picture(sums, tiles), i)

        shape = len(spans.tiles), self.slots.attributes.shape[1] + 2, SIDE**2
        nothing = zeros_after(spans.beyond, shape, spans.beyond.dtype)
        given = spans.beyond, spans.upto, spans.tiles
        return self.each_round(spans.tiles, given, add, nothing)

    @jit_unless_traced
    def limits_behind(
        self, spans: Spans
    ) -> tuple[Float[Array, "places pixels"], Float[Array, "places pixels"]]:
        """Find where the surface behind ends, of the fragments of some weight and of any; `beyond`
        is where the front ends in open pixels, -inf in others.
        """

        def look(i, lanes: Lanes, open_to, out):
            return _write(out, self.sweep.limits_behind(self.slots, lanes, open_to), i)

        nothing = zeros_after(spans.beyond, spans.beyond.shape, spans.beyond.dtype) - jnp.inf
        return self.each_round(spans.tiles, (spans.beyond,), look, (nothing, nothing))

    def each_round(self, tiles: Int[Array, " places"], given, function: Callable, out):
        """Apply `function(first place, lanes, *given, out)` to as many places at a time as there
        are lanes, up to the last tile.
        """
        grid, bins, dtype = self.sweep.grid, self.bins, self.slots.shift.dtype
        lane = jnp.full(grid.tiles + 1, bins.lanes, jnp.int32)
        lane = lane.at[bins.order[: bins.lanes]].set(jnp.arange(bins.lanes, dtype=jnp.int32))
        own = lane[jnp.where(tiles < grid.count, tiles, len(lane) - 1)]

        def step(i, out):
            here = i * grid.lanes
            parts = (lax.dynamic_slice_in_dim(each, here, grid.lanes) for each in (own, *given))
            picked, *rest = parts
            return function(here, self.sweep.lanes(bins, picked, dtype), *rest, out)

        places = jnp.arange(1, len(tiles) + 1, dtype=jnp.int32)
        last = jnp.max(jnp.where(tiles < grid.count, places, 0), initial=0)
        rounds = -(-last // grid.lanes)
        return lax.fori_loop(jnp.zeros_like(rounds), rounds, step, out)


def sum_parts(
    parts: Callable[[], Iterable[Sequence[PartSweep]]],
    capacities: Sequence[Places],
    combination: AbstractCombination,
) -> list[tuple[FragmentSums, Spans]]:
    """Sum the fragments of splats that are several parts, in several views at once.

    **Arguments:**

    - `parts`: iterates over the parts on this device whenever it is called; of each, the sweep of
      every view.
    - `capacities`: of each view.

    **Returns:** for each view the sums on this device, and over what.
    """
    first = next(iter(parts()))
    # Stage 1: where the front ends in any part.
    limits = combination.largest([each.limits() for each in part] for part in parts())
    fronts = [_front(*each, own) for each, own in zip(limits, capacities, strict=True)]
    # Stage 2: the sums of the front.
    sums = combination.own_total(
        [each.sums(spans) for each, (spans, _) in zip(part, fronts, strict=True)]
        for part in parts()
    )
    weights = combination.total([[rows[:, -1] for rows in sums]])
    # Stage 3: where the surface behind ends, in pixels that the front leaves open.
    opened = [
        _opened(spans, weights[k] < first[k].sweep.full_coverage, own, first[k].sweep.grid.count)
        for k, ((spans, _), own) in enumerate(zip(fronts, capacities, strict=True))
    ]
    limits = combination.largest(
        [each.limits_behind(spans) for each, (spans, _) in zip(part, opened, strict=True)]
        for part in parts()
    )
    behind = [
        eqx.tree_at(lambda each: each.beyond, spans, second_limits(*each))
        for each, (spans, _) in zip(limits, opened, strict=True)
    ]
    # Stage 4: the sums of the surface behind.
    rest = combination.own_total(
        [each.sums(spans) for each, spans in zip(part, behind, strict=True)] for part in parts()
    )
    found = []
    for k, capacity in enumerate(capacities):
        spans, rows = jax.tree.map(
            lambda whole, part, front=capacity.front: whole.at[front:].set(part),
            (fronts[k][0], sums[k]),
            (behind[k], rest[k]),
        )
        needs = first[k].bins.needed, fronts[k][1], opened[k][1]
        needed = combination.largest(
            [jnp.max(jnp.stack([each.astype(rows.dtype) for each in needs]))]
        )
        found.append((FragmentSums(spans.tiles, rows, needed, capacity.front), spans))
    return found


def _front(limits, lengths, capacity: Places) -> tuple[Spans, Float[Array, ""]]:
    """Choose the places of the front, and leave room for those behind; also return the places
    needed over planned.

    Longer lists come first: tiles that are swept together have lists of about one length.
    """
    order = jnp.argsort(-lengths)
    shown = jnp.any(limits > -jnp.inf, axis=1)
    picked = _listed(shown[order], capacity.front)
    picked = jnp.pad(picked, (0, capacity.behind), constant_values=len(order))
    tiles = _taken(order.astype(jnp.int32), picked, len(order))
    beyond = _taken(limits, tiles, jnp.inf)
    beyond = jnp.where(beyond > -jnp.inf, beyond, jnp.inf)
    return Spans(tiles, beyond, jnp.full_like(beyond, jnp.inf)), jnp.sum(shown) / capacity.front


def _opened(front: Spans, is_open, capacity: Places, count: int) -> tuple[Spans, Float[Array, ""]]:
    """Choose the places with pixels that the front leaves open: behind what `upto` says, and in
    open pixels alone what `beyond` says; also return the places needed over planned.
    """
    is_open &= front.beyond < jnp.inf
    chosen = jnp.any(is_open, axis=1)
    picked = _listed(chosen, capacity.behind)
    tiles = _taken(front.tiles, picked, count)
    upto = _taken(front.beyond, picked, -jnp.inf)
    open_to = jnp.where(_taken(is_open, picked, False), upto, -jnp.inf)
    return Spans(tiles, open_to, upto), jnp.sum(chosen) / capacity.behind


def _listed(chosen: Bool[Array, " all"], size: int) -> Int[Array, " size"]:
    """List the indices of the chosen ones; their number for empty places."""
    return jnp.nonzero(chosen, size=size, fill_value=len(chosen))[0].astype(jnp.int32)


def _taken(whole: Array, places: Int[Array, " places"], fill) -> Array:
    return whole.at[places].get(mode="fill", fill_value=fill)


def _write(out, parts, place):
    """Write parts from a place on."""
    return jax.tree.map(
        lambda whole, part: lax.dynamic_update_slice_in_dim(whole, part, place, 0), out, parts
    )
