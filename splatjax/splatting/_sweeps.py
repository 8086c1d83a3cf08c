"""Passes 2 and 3 tile by tile: fragments are summed per pixel, with a derivative that recomputes
the weights.

A tile is swept twice: for the depth at which the front ends, then for its sums. Tiles with a pixel
that the front leaves open are swept twice more for the surface behind. Each of these stages must
know what the one before found in all parts of the splats. The backward sweep needs only the depths
at which the surfaces end.
"""

import dataclasses
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
from ._rasterizer import FragmentSums, PixelSums, Places


class Spans(eqx.Module):
    """Which fragments are summed, in the pixels of some tiles: those between two depths.

    **Attributes:**

    - `tiles`: the tile at each place; the number of tiles for none.
    - `beyond`: fragments count that are nearer than this; inf where there are none.
    - `upto`: fragments count that are not nearer than this.
    - `needed`: places needed over planned.
    """

    tiles: Int[Array, " places"]
    beyond: Float[Array, "places pixels"]
    upto: Float[Array, "places pixels"]
    needed: Float[Array, ""]

    @classmethod
    def front(
        cls, limits: Float[Array, "tiles pixels"], lengths: Int[Array, " tiles"], size: int
    ) -> "Spans":
        """Choose the places of the front. Longer lists come first: tiles that are swept together
        have lists of about one length.
        """
        order = jnp.argsort(-lengths)
        shown = jnp.any(limits > -jnp.inf, axis=1)
        tiles = _taken(order.astype(jnp.int32), _listed(shown[order], size), len(order))
        beyond = _taken(limits, tiles, jnp.inf)
        beyond = jnp.where(beyond > -jnp.inf, beyond, jnp.inf)
        needed = (jnp.sum(shown) / size).astype(limits.dtype)
        return cls(tiles, beyond, jnp.full_like(beyond, jnp.inf), needed)

    def opened(self, is_open: Bool[Array, "places pixels"], size: int, none: int) -> "Spans":
        """Choose the places with pixels that the front leaves open: behind what `upto` says, and
        in open pixels alone what `beyond` says.
        """
        is_open &= self.beyond < jnp.inf
        chosen = jnp.any(is_open, axis=1)
        picked = _listed(chosen, size)
        upto = _taken(self.beyond, picked, -jnp.inf)
        open_to = jnp.where(_taken(is_open, picked, False), upto, -jnp.inf)
        needed = (jnp.sum(chosen) / size).astype(upto.dtype)
        return Spans(_taken(self.tiles, picked, none), open_to, upto, needed)

    def followed_by(self, behind: "Spans") -> "Spans":
        """Append the places of the surface behind."""
        needed = jnp.maximum(self.needed, behind.needed)
        return Spans(
            tiles=jnp.concatenate([self.tiles, behind.tiles]),
            beyond=jnp.concatenate([self.beyond, behind.beyond]),
            upto=jnp.concatenate([self.upto, behind.upto]),
            needed=needed,
        )


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
    dtype, cotangent = shift.dtype, cotangent.sums

    def add(_, *given):
        return sweep.add_cotangents(part.slots, *given)

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

    def nothing(self, front: Spans, capacity: Places) -> PixelSums:
        """Return sums over no fragments, for the places of both surfaces."""
        places, attributes = capacity.front + capacity.behind, self.slots.attributes
        known, dtype = (front.beyond, attributes), front.beyond.dtype
        rows = zeros_after(known, (places, attributes.shape[1] + 1, SIDE**2), dtype)
        return PixelSums(rows, zeros_after(known, (places, SIDE**2), dtype))

    @jit_unless_traced
    def add_sums(self, spans: Spans, so_far: PixelSums, first: int) -> PixelSums:
        """Add the sums over the fragments of some spans to others, from a first place on."""

        def add(i, lanes: Lanes, beyond, upto, tiles, so_far):
            sums = self.sweep.within_picture(
                self.sweep.sums(self.slots, lanes, beyond, upto), tiles
            )
            own = _sliced(so_far, first + i, len(tiles))
            return _write(so_far, jax.tree.map(jnp.add, own, sums), first + i)

        given = spans.beyond, spans.upto, spans.tiles
        return self.each_round(spans.tiles, given, add, so_far)

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
            picked, *rest = _sliced((own, *given), here, grid.lanes)
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
    first, views = next(iter(parts())), range(len(capacities))
    # Stage 1: where the front ends in any part.
    limits = combination.largest([each.limits() for each in part] for part in parts())
    fronts = [Spans.front(*limits[k], capacities[k].front) for k in views]

    # Stage 2: the sums of the front.
    def add_front(sums, part):
        return [part[k].add_sums(fronts[k], sums[k], 0) for k in views]

    nothing = [first[k].nothing(fronts[k], capacities[k]) for k in views]
    sums = combination.fold(add_front, nothing, parts())
    # Stage 3: where the surface behind ends, in pixels that the front leaves open.
    weights = combination.total([[sums[k].weights[: capacities[k].front] for k in views]])
    opened = []
    for k, own in enumerate(capacities):
        sweep = first[k].sweep
        is_open = weights[k] < sweep.full_coverage
        opened.append(fronts[k].opened(is_open, own.behind, sweep.grid.count))
    limits = combination.largest(
        [part[k].limits_behind(opened[k]) for k in views] for part in parts()
    )
    behind = [dataclasses.replace(opened[k], beyond=second_limits(*limits[k])) for k in views]

    # Stage 4: the sums of the surface behind.
    def add_behind(sums, part):
        return [part[k].add_sums(behind[k], sums[k], capacities[k].front) for k in views]

    sums = combination.fold(add_behind, sums, parts())
    found = []
    for k, own in enumerate(capacities):
        spans = fronts[k].followed_by(behind[k])
        lists = first[k].bins.needed.astype(spans.needed.dtype)
        needed = combination.largest([jnp.maximum(spans.needed, lists)])
        found.append((FragmentSums(spans.tiles, sums[k], needed, own.front), spans))
    return found


def _listed(chosen: Bool[Array, " all"], size: int) -> Int[Array, " size"]:
    """List the indices of the chosen ones; their number for empty places."""
    return jnp.nonzero(chosen, size=size, fill_value=len(chosen))[0].astype(jnp.int32)


def _taken(whole: Array, places: Int[Array, " places"], fill) -> Array:
    return whole.at[places].get(mode="fill", fill_value=fill)


def _sliced(whole, place, size: int):
    """Read so many rows from a place on."""
    return jax.tree.map(lambda each: lax.dynamic_slice_in_dim(each, place, size), whole)


def _write(out, parts, place):
    """Write parts from a place on."""
    return jax.tree.map(
        lambda whole, part: lax.dynamic_update_slice_in_dim(whole, part, place, 0), out, parts
    )
