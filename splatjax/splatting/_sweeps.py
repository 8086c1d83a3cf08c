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

from splatjax._chunking import jit_unless_traced, needed_over_planned, zeros_after
from splatjax._combination import AbstractCombination
from splatjax._precision import full_precision

from ._bins import TILE_SIDE, Bins, TileGrid
from ._fragments import Lanes, Sweep
from ._rasterizer import FragmentSums, PixelSums, SurfaceCapacity
from ._views import AbstractView, SplattingSettings


class Spans(eqx.Module):
    """The range of summed fragments in the pixels of some tiles: `far_limit < nearness <=
    near_limit`.

    **Attributes:**

    - `tiles`: the tile at each place; the number of tiles in an empty place.
    - `far_limit`, `near_limit`: nearness. Both are -inf in pixels without fragments.
    """

    tiles: Int[Array, " places"]
    far_limit: Float[Array, "places pixels"]
    near_limit: Float[Array, "places pixels"]

    @classmethod
    def front(
        cls, limits: Float[Array, "tiles pixels"], lengths: Int[Array, " tiles"], size: int
    ) -> tuple["Spans", Float[Array, ""]]:
        """Choose the places of the front, and compute the places needed over planned. Longer lists
        come first, so that tiles that are swept together have lists of similar length.
        """
        order = jnp.argsort(-lengths)
        shown = jnp.any(limits > -jnp.inf, axis=1)
        tiles = _taken(order.astype(jnp.int32), _listed(shown[order], size), len(order))
        far_limit = _taken(limits, tiles, -jnp.inf)
        near_limit = jnp.where(far_limit > -jnp.inf, jnp.inf, far_limit)
        return cls(tiles, far_limit, near_limit), needed_over_planned(jnp.sum(shown), size)

    def opened(self, is_open: Bool[Array, "places pixels"], size: int, none: int):
        """Choose the places with pixels that the front leaves open.

        **Returns:** their tiles, the near limit of the surface behind in open pixels, -inf in
        others, and the places needed over planned.
        """
        open_limit = jnp.where(is_open, self.far_limit, -jnp.inf)
        chosen = jnp.any(open_limit > -jnp.inf, axis=1)
        listed, needed = _listed(chosen, size), needed_over_planned(jnp.sum(chosen), size)
        return _taken(self.tiles, listed, none), _taken(open_limit, listed, -jnp.inf), needed


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2, 3, 4))
def sum_tile_fragments(
    capacity: SurfaceCapacity,
    combination: AbstractCombination,
    view_class: type[AbstractView],
    grid: TileGrid,
    settings: SplattingSettings,
    bins: Bins,
    shift: Float[Array, " splats"],
    planes: tuple[Float[Array, " splats"], ...],
    attributes: Float[Array, "splats attributes"],
) -> FragmentSums:
    """Sum attributes over the splats of every tile: this device's part of the sums.

    **Arguments:** `view_class` and all after it as for `Sweep.of`.
    """
    kind = view_class, grid, settings
    return _sum_fwd(capacity, combination, *kind, bins, shift, planes, attributes)[0]


def _sum_fwd(capacity, combination, *given):
    sweep = Sweep.of(*given)
    ((sums, spans),) = sum_parts(lambda: [[sweep]], [capacity], combination)
    return sums, (given[3:], spans)


@full_precision
def _sum_bwd(capacity, combination, view_class, grid, settings, residuals, cotangent):
    (bins, shift, planes, attributes), spans = residuals
    sweep = Sweep.of(view_class, grid, settings, bins, shift, planes, attributes)
    dtype, cotangent = shift.dtype, cotangent.sums

    def add(_, *arguments):
        return sweep.add_cotangents(*arguments)

    def scattered(slots):
        return jnp.zeros_like(shift).at[sweep.ids].add(slots, mode="drop")

    of_planes = tuple(zeros_after(cotangent, sweep.shift.shape, dtype) for _ in planes)
    gradients = of_planes, zeros_after(cotangent, attributes.shape, dtype)
    given = spans.far_limit, spans.near_limit, cotangent
    of_planes, of_rows = each_round(sweep, spans.tiles, given, add, gradients)
    return None, None, tuple(map(scattered, of_planes)), of_rows


sum_tile_fragments.defvjp(_sum_fwd, _sum_bwd)


@jit_unless_traced
def front_limits(sweep: Sweep) -> tuple[Float[Array, "tiles pixels"], Int[Array, " tiles"]]:
    """Compute the end of the front, -inf without one; and the length of each list."""
    grid, bins, dtype = sweep.grid, sweep.bins, sweep.shift.dtype
    order = bins.order[: bins.planned_lanes]

    def look(place, lanes: Lanes, limits):
        return _write(limits, sweep.limits(lanes), place)

    none = zeros_after(sweep.shift, (len(order), TILE_SIDE**2), dtype) - jnp.inf
    limits = each_round(sweep, order, (), look, none)
    limits = jnp.where(grid.within_picture(order), limits, -jnp.inf)
    every = jnp.full((grid.count, TILE_SIDE**2), -jnp.inf, dtype)
    lengths = jnp.repeat(jnp.diff(bins.first_block), grid.lanes)
    lengths = jnp.zeros(grid.count, jnp.int32).at[bins.order].set(lengths, mode="drop")
    return every.at[order].set(limits, mode="drop"), lengths


@jit_unless_traced
def add_sums(sweep: Sweep, spans: Spans, so_far: PixelSums, first: int) -> PixelSums:
    """Add the sums over the fragments of some spans to others, from a first place on."""

    def add(place, lanes: Lanes, far_limit, near_limit, so_far):
        sums = sweep.sums(lanes, far_limit, near_limit)
        before = _sliced(so_far, first + place, len(far_limit))
        return _write(so_far, jax.tree.map(jnp.add, before, sums), first + place)

    return each_round(sweep, spans.tiles, (spans.far_limit, spans.near_limit), add, so_far)


@jit_unless_traced
def limits_behind(
    sweep: Sweep, tiles: Int[Array, " places"], open_limit: Float[Array, "places pixels"]
) -> tuple[Float[Array, "places pixels"], Float[Array, "places pixels"]]:
    """Compute the end of the surface behind, for the fragments of sufficient weight and for all;
    `open_limit` is the end of the front in open pixels, and -inf in others.
    """

    def look(place, lanes: Lanes, open_limit, limits):
        return _write(limits, sweep.limits_behind(lanes, open_limit), place)

    none = zeros_after(open_limit, open_limit.shape, open_limit.dtype) - jnp.inf
    return each_round(sweep, tiles, (open_limit,), look, (none, none))


def each_round(sweep: Sweep, tiles: Int[Array, " places"], given, function: Callable, out):
    """Apply `function(first place, lanes, *given, out)` to the places, as many at a time as there
    are lanes, up to the last tile.
    """
    grid, bins, planned = sweep.grid, sweep.bins, sweep.bins.planned_lanes
    # The lane of every tile, and of every place; `planned` where the list is empty.
    of_tile = jnp.full(grid.padded_count + 1, planned, jnp.int32)
    of_tile = of_tile.at[bins.order[:planned]].set(jnp.arange(planned, dtype=jnp.int32))
    of_place = of_tile[jnp.where(tiles < grid.count, tiles, grid.padded_count)]

    def step(i, out):
        first = i * grid.lanes
        lane_numbers, *arguments = _sliced((of_place, *given), first, grid.lanes)
        return function(first, sweep.lanes(lane_numbers), *arguments, out)

    ends = jnp.arange(1, len(tiles) + 1, dtype=jnp.int32)
    last = jnp.max(jnp.where(tiles < grid.count, ends, 0), initial=0)
    rounds = -(-last // grid.lanes)
    return jax.lax.fori_loop(jnp.zeros_like(rounds), rounds, step, out)


def sum_parts(
    parts: Callable[[], Iterable[Sequence[Sweep]]],
    capacities: Sequence[SurfaceCapacity],
    combination: AbstractCombination,
) -> list[tuple[FragmentSums, Spans]]:
    """Sum the fragments of several parts of splats, in several views at once.

    **Arguments:**

    - `parts`: each call iterates over the parts on this device, and gives the sweep of every view.
    - `capacities`: of each view.

    **Returns:** for each view the sums on this device, and their spans.
    """
    first, views = next(iter(parts())), range(len(capacities))  # by their numbers
    # Stage 1: the end of the front over all parts.
    limits = combination.largest([front_limits(sweep) for sweep in part] for part in parts())
    fronts = [Spans.front(*limits[k], capacities[k].front) for k in views]

    # Stage 2: the sums of the front.
    def add_front(sums, part):
        return [add_sums(part[k], fronts[k][0], sums[k], 0) for k in views]

    empty_sums = [_empty_sums(first[k], fronts[k][0], capacities[k]) for k in views]
    sums = combination.fold(add_front, empty_sums, parts())
    # Stage 3: the end of the surface behind, in pixels that the front leaves open.
    weights = combination.total([[sums[k].weights[: capacities[k].front] for k in views]])
    opened = [
        front.opened(weight < sweep.settings.full_coverage, capacity.behind, sweep.grid.count)
        for (front, _), weight, sweep, capacity in zip(
            fronts, weights, first, capacities, strict=True
        )
    ]
    limits = combination.largest(
        [limits_behind(part[k], *opened[k][:2]) for k in views] for part in parts()
    )

    # Stage 4: the sums of the surface behind.
    behind = [
        Spans(tiles, jnp.where(weighty > -jnp.inf, weighty, of_any), open_limit)
        for (tiles, open_limit, _), (weighty, of_any) in zip(opened, limits, strict=True)
    ]

    def add_behind(sums, part):
        return [add_sums(part[k], behind[k], sums[k], capacities[k].front) for k in views]

    sums = combination.fold(add_behind, sums, parts())
    results = []
    for k, capacity in enumerate(capacities):
        (front, front_needed), (*_, behind_needed) = fronts[k], opened[k]
        spans = jax.tree.map(lambda *rows: jnp.concatenate(rows), front, behind[k])
        # Lists only of the first part: a device has one, or it streams parts for which the
        # capacity of the lists was planned.
        needed = jnp.stack([front_needed, behind_needed, first[k].bins.needed])
        needed = combination.largest([jnp.max(needed).astype(spans.far_limit.dtype)])
        results.append((FragmentSums(spans.tiles, sums[k], needed, capacity.front), spans))
    return results


def _empty_sums(sweep: Sweep, front: Spans, capacity: SurfaceCapacity) -> PixelSums:
    """Return sums over no fragments, for the places of both surfaces."""
    places, attributes = capacity.front + capacity.behind, sweep.attributes
    known, dtype = (front.far_limit, attributes), front.far_limit.dtype
    rows = zeros_after(known, (places, attributes.shape[1] + 1, TILE_SIDE**2), dtype)
    return PixelSums(rows, zeros_after(known, (places, TILE_SIDE**2), dtype))


def _listed(chosen: Bool[Array, " all"], size: int) -> Int[Array, " size"]:
    """List the indices of the chosen ones; their number for empty places."""
    return jnp.nonzero(chosen, size=size, fill_value=len(chosen))[0].astype(jnp.int32)


def _taken(whole: Array, places: Int[Array, " places"], fill) -> Array:
    return whole.at[places].get(mode="fill", fill_value=fill)


def _sliced(whole, place, size: int):
    """Read so many rows from a place on."""
    return jax.tree.map(lambda rows: jax.lax.dynamic_slice_in_dim(rows, place, size), whole)


def _write(out, parts, place):
    """Write parts from a place on."""
    return jax.tree.map(
        lambda whole, part: jax.lax.dynamic_update_slice_in_dim(whole, part, place, 0), out, parts
    )
