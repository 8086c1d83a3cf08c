"""Passes 2 and 3 tile by tile: fragments are summed per pixel, with a derivative that recomputes
the weights.

A tile is swept twice: for the depth at which the front ends, then for its sums. Tiles with a pixel
that the front leaves open are swept twice more for the surface behind. Each of these stages needs
the result of the one before over all parts of the splats. The backward sweep needs only the depths
at which the surfaces end.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import (
    divided,
    jit_unless_traced,
    list_chosen,
    materialized,
    needed_over_planned,
    zeros_after,
)
from splatjax._combination import AbstractCombination
from splatjax._precision import full_precision

from ._bins import Bins
from ._fragments import NUMBERS, Lanes, Listed, Sweep, second_limits
from ._grid import TILE_SIDE
from ._rasterizer import FragmentSums, PixelSums, SurfaceCapacity


class Spans(eqx.Module):
    """The range of summed fragments in the pixels of some tiles: `far_limit < nearness <=
    near_limit`.

    **Attributes:**

    - `tiles`: the tile at each place; the number of tiles in an empty place.
    - `far_limit`, `near_limit`: nearness. `far_limit` is inf without fragments.
    - `needed`: places needed over planned.
    """

    tiles: Int[Array, " places"]
    far_limit: Float[Array, "places pixels"]
    near_limit: Float[Array, "places pixels"]
    needed: Float[Array, ""]

    @classmethod
    def front(
        cls, limits: Float[Array, "tiles pixels"], lengths: Int[Array, " tiles"], size: int
    ) -> "Spans":
        """Choose the places of the front. Longer lists come first, so that tiles that are swept
        together have lists of similar length.
        """
        order = jnp.argsort(-lengths)
        shown = jnp.any(limits > -jnp.inf, axis=1)
        tiles = _taken(order.astype(jnp.int32), list_chosen(shown[order], size), len(order))
        far_limit = _taken(limits, tiles, jnp.inf)
        far_limit = jnp.where(far_limit > -jnp.inf, far_limit, jnp.inf)
        needed = needed_over_planned(jnp.sum(shown), size).astype(limits.dtype)
        return cls(tiles, far_limit, jnp.full_like(far_limit, jnp.inf), needed)

    def opened(self, is_open: Bool[Array, "places pixels"], size: int, none: int):
        """Choose the places with pixels that the front leaves open.

        Returns their tiles, the near limit of the surface behind, the same in open pixels and -inf
        in others, and the places needed over planned.
        """
        is_open &= self.far_limit < jnp.inf
        chosen = jnp.any(is_open, axis=1)
        listed = list_chosen(chosen, size)
        near_limit = _taken(self.far_limit, listed, -jnp.inf)
        open_limit = jnp.where(_taken(is_open, listed, False), near_limit, -jnp.inf)
        needed = needed_over_planned(jnp.sum(chosen), size).astype(near_limit.dtype)
        return _taken(self.tiles, listed, none), near_limit, open_limit, needed

    def followed_by(self, behind: "Spans") -> "Spans":
        """Append the places of the surface behind."""
        return Spans(
            tiles=jnp.concatenate([self.tiles, behind.tiles]),
            far_limit=jnp.concatenate([self.far_limit, behind.far_limit]),
            near_limit=jnp.concatenate([self.near_limit, behind.near_limit]),
            needed=jnp.maximum(self.needed, behind.needed),
        )


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def sum_tile_fragments(
    sweep: Sweep,
    capacity: SurfaceCapacity,
    combination: AbstractCombination,
    hidden_from: Float[Array, ""],
    bins: Bins,
    shift: Float[Array, " splats"],
    numbers: tuple[Float[Array, " splats"], ...],
    attributes: Float[Array, "attributes splats"],
) -> FragmentSums:
    """Sum attributes over the splats of every tile: this device's part of the sums."""
    listed = hidden_from, bins, shift, numbers, attributes
    return _sum_fwd(sweep, capacity, combination, *listed)[0]


def _sum_fwd(sweep, capacity, combination, *listed):
    part = PartSweep(sweep, Listed.of(*listed))
    ((sums, spans),) = sum_parts(lambda: [[part]], [capacity], combination)
    return sums, (part, spans)


@full_precision
def _sum_bwd(sweep: Sweep, capacity: SurfaceCapacity, combination, residuals, cotangent):
    (part, spans), cotangent = residuals, cotangent.sums
    listed = part.listed

    def add(_, *arguments):
        return sweep.add_cotangents(listed, *arguments)

    fields, attributes = len(NUMBERS), listed.attributes.shape[1]
    shape = len(listed.numbers), fields + attributes
    gradients = zeros_after(cotangent, shape, listed.numbers.dtype)
    rows = spans.far_limit, spans.near_limit, cotangent
    planes = materialized(part.each_round(spans.tiles, rows, add, gradients).T)[:, :-1]
    return None, None, None, tuple(planes[:fields]), planes[fields:]


sum_tile_fragments.defvjp(_sum_fwd, _sum_bwd)


class PartSweep(eqx.Module):
    """The separate stages of the sweep, for splats that may be one of several parts: splats of
    another part may be in front.
    """

    sweep: Sweep
    listed: Listed

    @jit_unless_traced
    def limits(self) -> tuple[Float[Array, "tiles pixels"], Int[Array, " tiles"]]:
        """Compute the end of the front, -inf without one; and the blocks of each list."""
        grid, bins, dtype = self.sweep.grid, self.listed.bins, self.listed.numbers.dtype

        def look(_, lanes: Lanes, limits):
            new = self.sweep.limits(self.listed, lanes)
            return limits.at[lanes.tiles].set(new, mode="drop")

        limits = zeros_after(self.listed.numbers, (grid.count, TILE_SIDE**2), dtype) - jnp.inf
        listed = jnp.where(bins.counts[bins.order] > 0, bins.order, grid.count)
        return self.each_round(listed, (), look, limits), grid.blocks(bins.counts[: grid.count])

    def empty_sums(self, front: Spans, capacity: SurfaceCapacity) -> PixelSums:
        """Return sums over no fragments, for the places of both surfaces."""
        places, attributes = capacity.front + capacity.behind, self.listed.attributes
        inputs, dtype = (front.far_limit, attributes), front.far_limit.dtype
        rows = zeros_after(inputs, (places, attributes.shape[1] + 1, TILE_SIDE**2), dtype)
        return PixelSums(rows, zeros_after(inputs, (places, TILE_SIDE**2), dtype))

    @jit_unless_traced
    def add_sums(self, spans: Spans, so_far: PixelSums, first: int) -> PixelSums:
        """Add the sums over the fragments of some spans to others, from a first place on."""

        def add(i, lanes: Lanes, far_limit, near_limit, tiles, so_far):
            sums = self.sweep.within_picture(
                self.sweep.sums(self.listed, lanes, far_limit, near_limit), tiles
            )
            before = _sliced(so_far, first + i, len(tiles))
            return _write(so_far, jax.tree.map(jnp.add, before, sums), first + i)

        rows = spans.far_limit, spans.near_limit, spans.tiles
        return self.each_round(spans.tiles, rows, add, so_far)

    @jit_unless_traced
    def limits_behind(
        self, tiles: Int[Array, " places"], open_limit: Float[Array, "places pixels"]
    ) -> tuple[Float[Array, "places pixels"], Float[Array, "places pixels"]]:
        """Compute the end of the surface behind, for the fragments of sufficient weight and for
        all; `open_limit` is the end of the front in open pixels, and -inf in others.
        """

        def look(i, lanes: Lanes, open_limit, limits):
            return _write(limits, self.sweep.limits_behind(self.listed, lanes, open_limit), i)

        none = zeros_after(open_limit, open_limit.shape, open_limit.dtype) - jnp.inf
        return self.each_round(tiles, (open_limit,), look, (none, none))

    def each_round(self, tiles: Int[Array, " places"], rows, function: Callable, out):
        """Apply `function(first place, lanes, *rows, out)` to the places, as many at a time as
        there are lanes, up to the last tile.
        """
        grid, bins, dtype = self.sweep.grid, self.listed.bins, self.listed.numbers.dtype

        def step(i, out):
            first = i * grid.lanes
            chunk, *arguments = _sliced((tiles, *rows), first, grid.lanes)
            return function(first, self.sweep.lanes(bins, chunk, dtype), *arguments, out)

        ends = jnp.arange(1, len(tiles) + 1, dtype=jnp.int32)
        last = jnp.max(jnp.where(tiles < grid.count, ends, 0), initial=0)
        rounds, _ = divided(last + (grid.lanes - 1), grid.lanes)
        return jax.lax.fori_loop(jnp.zeros_like(rounds), rounds, step, out)


def sum_parts(
    parts: Callable[[], Iterable[Sequence[PartSweep]]],
    capacities: Sequence[SurfaceCapacity],
    combination: AbstractCombination,
) -> list[tuple[FragmentSums, Spans]]:
    """Sum the fragments of several parts of splats, in several views at once.

    **Arguments:**

    - `parts`: each call iterates over the parts on this device, and gives the sweep of every view.
    - `capacities`: capacity of each view.

    **Returns:** for each view the sums on this device, and their spans.
    """
    first, views = next(iter(parts())), range(len(capacities))  # by their numbers
    # Stage 1: the end of the front over all parts.
    limits = combination.largest([sweep.limits() for sweep in part] for part in parts())
    fronts = [Spans.front(*limits[k], capacities[k].front) for k in views]

    # Stage 2: the sums of the front.
    def add_front(sums, part):
        return [part[k].add_sums(fronts[k], sums[k], 0) for k in views]

    empty_sums = [first[k].empty_sums(fronts[k], capacities[k]) for k in views]
    sums = combination.fold(add_front, empty_sums, parts())
    # Stage 3: the end of the surface behind, in pixels that the front leaves open.
    weights = combination.total([[sums[k].weights[: capacities[k].front] for k in views]])
    opened = []
    for k, capacity in enumerate(capacities):
        sweep = first[k].sweep
        is_open = weights[k] < first[k].listed.hidden_from
        opened.append(fronts[k].opened(is_open, capacity.behind, sweep.grid.count))
    tiles, near_limits, open_limits, needed = zip(*opened, strict=True)
    limits = combination.largest(
        [part[k].limits_behind(tiles[k], open_limits[k]) for k in views] for part in parts()
    )

    # Stage 4: the sums of the surface behind.
    far_limits = [second_limits(*limits[k]) for k in views]
    behind = [Spans(*span) for span in zip(tiles, far_limits, near_limits, needed, strict=True)]

    def add_behind(sums, part):
        return [part[k].add_sums(behind[k], sums[k], capacities[k].front) for k in views]

    sums = combination.fold(add_behind, sums, parts())
    results = []
    for k, capacity in enumerate(capacities):
        spans = fronts[k].followed_by(behind[k])
        # Only of the first part: a device has one, or it streams parts for which the capacity of
        # the lists was planned.
        lists = first[k].listed.bins.needed.astype(spans.needed.dtype)
        needed = combination.largest([jnp.maximum(spans.needed, lists)])
        results.append((FragmentSums(spans.tiles, sums[k], needed, capacity.front), spans))
    return results


def _taken(array: Array, places: Int[Array, " places"], fill) -> Array:
    return array.at[places].get(mode="fill", fill_value=fill)


def _sliced(arrays, place, size: int):
    """Read so many rows from a place on."""
    return jax.tree.map(lambda rows: jax.lax.dynamic_slice_in_dim(rows, place, size), arrays)


def _write(out, parts, place):
    """Write parts from a place on."""
    return jax.tree.map(
        lambda array, part: jax.lax.dynamic_update_slice_in_dim(array, part, place, 0), out, parts
    )
