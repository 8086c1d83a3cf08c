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
from ._fragments import NUMBERS, PartSweep, SweepSettings
from ._grid import TILE_SIDE, TileGrid
from ._rasterizer import FragmentSums, PixelSums, SurfaceCapacity, may_show_behind


class Spans(eqx.Module):
    """The range of summed fragments in the pixels of some tiles: `far_limit < nearness <=
    near_limit`.

    **Attributes:**

    - `tiles`: the tile at each place; the number of tiles in an empty place.
    - `far_limit`, `near_limit`: nearness. `far_limit` is inf without fragments.
    """

    tiles: Int[Array, " places"]
    far_limit: Float[Array, "places pixels"]
    near_limit: Float[Array, "places pixels"]

    @classmethod
    def front(
        cls,
        limits: Float[Array, "tiles pixels"],
        lengths: Int[Array, " tiles"],
        grid: TileGrid,
        size: int,
    ) -> tuple["Spans", Float[Array, ""]]:
        """Choose the places of the front, and compute the places needed over planned. Longer lists
        come first, so that tiles that are swept together have lists of similar length.
        """
        order = jnp.argsort(-lengths)
        shown = jnp.any(limits > -jnp.inf, axis=1)
        tiles = _taken(order.astype(jnp.int32), list_chosen(shown[order], size), grid.count)
        far_limit = _taken(limits, tiles, -jnp.inf)
        exists = far_limit > -jnp.inf
        if grid.width % TILE_SIDE or grid.height % TILE_SIDE:
            exists &= grid.within_picture(tiles)
        far_limit = jnp.where(exists, far_limit, jnp.inf)
        needed = needed_over_planned(jnp.sum(shown), size).astype(limits.dtype)
        return cls(tiles, far_limit, jnp.full_like(far_limit, jnp.inf)), needed

    def opened(self, is_open: Bool[Array, "places pixels"], size: int, none: int):
        """Choose the places with pixels that the front leaves open.

        Returns their tiles, the near limit of the surface behind, -inf in other pixels, and the
        places needed over planned.
        """
        near_limit = jnp.where(is_open & (self.far_limit < jnp.inf), self.far_limit, -jnp.inf)
        chosen = jnp.any(near_limit > -jnp.inf, axis=1)
        listed = list_chosen(chosen, size)
        needed = needed_over_planned(jnp.sum(chosen), size).astype(near_limit.dtype)
        return _taken(self.tiles, listed, none), _taken(near_limit, listed, -jnp.inf), needed


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def sum_tile_fragments(
    settings: SweepSettings,
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
    return _sum_fwd(settings, capacity, combination, *listed)[0]


def _sum_fwd(settings, capacity, combination, *listed):
    part = PartSweep.of(settings, *listed)
    ((sums, spans),) = sum_parts(lambda: [[part]], [capacity], combination)
    return sums, (part, spans)


@full_precision
def _sum_bwd(settings, capacity, combination, residuals, cotangent):
    (part, spans), cotangent = residuals, cotangent.sums

    def add(_, *arguments):
        return part.add_cotangents(*arguments)

    fields, attributes = len(NUMBERS), part.attributes.shape[1]
    shape = len(part.numbers), fields + attributes
    gradients = zeros_after(cotangent, shape, part.numbers.dtype)
    rows = spans.far_limit, spans.near_limit, cotangent
    planes = materialized(_each_round(part, spans.tiles, rows, add, gradients).T)[:, :-1]
    return None, None, None, tuple(planes[:fields]), planes[fields:]


sum_tile_fragments.defvjp(_sum_fwd, _sum_bwd)


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
    limits = combination.largest([_front_limits(sweep) for sweep in part] for part in parts())
    fronts, front_needed = zip(
        *(Spans.front(*limits[k], first[k].grid, capacities[k].front) for k in views), strict=True
    )

    # Stage 2: the sums of the front.
    def add_front(sums, part):
        return [_add_sums(part[k], fronts[k], sums[k], 0) for k in views]

    sums = [_empty_sums(first[k], fronts[k], capacities[k]) for k in views]
    sums = combination.fold(add_front, sums, parts())
    # Stage 3: the end of the surface behind, in pixels that the front leaves open.
    weights = combination.total([[sums[k].weights[: capacities[k].front] for k in views]])
    is_open = [_open_pixels(weights[k], fronts[k].tiles, first[k]) for k in views]
    tiles, near_limits, behind_needed = zip(
        *(fronts[k].opened(is_open[k], capacities[k].behind, first[k].grid.count) for k in views),
        strict=True,
    )
    limits = combination.largest(
        [_limits_behind(part[k], tiles[k], near_limits[k]) for k in views] for part in parts()
    )

    # Stage 4: the sums of the surface behind.
    behind = [Spans(tiles[k], _second_limits(*limits[k]), near_limits[k]) for k in views]

    def add_behind(sums, part):
        return [_add_sums(part[k], behind[k], sums[k], capacities[k].front) for k in views]

    sums = combination.fold(add_behind, sums, parts())
    results = []
    for k, capacity in enumerate(capacities):
        spans = jax.tree.map(lambda *pair: jnp.concatenate(pair), fronts[k], behind[k])
        # The first part suffices: a device has one part, or a stream for all of whose parts the
        # capacity of the lists was planned.
        lists = first[k].bins.needed.astype(front_needed[k].dtype)
        needed = jnp.stack([front_needed[k], behind_needed[k], lists])
        needed = combination.largest([jnp.max(needed)])
        results.append((FragmentSums(spans.tiles, sums[k], needed, capacity.front), spans))
    return results


@jit_unless_traced
def _front_limits(part: PartSweep) -> tuple[Float[Array, "tiles pixels"], Int[Array, " tiles"]]:
    """Compute the end of the front, -inf without one; and the blocks of each list."""
    grid, bins = part.grid, part.bins

    def look(_, lanes, limits):
        return limits.at[lanes].set(part.front_limits(lanes), mode="drop")

    limits = zeros_after(part.numbers, (grid.count, TILE_SIDE**2), part.numbers.dtype) - jnp.inf
    listed = jnp.where(bins.counts[bins.order] > 0, bins.order, grid.count)
    return _each_round(part, listed, (), look, limits), grid.blocks(bins.counts[: grid.count])


def _empty_sums(part: PartSweep, front: Spans, capacity: SurfaceCapacity) -> PixelSums:
    """Return sums over no fragments, for the places of both surfaces."""
    places, inputs = capacity.front + capacity.behind, (front.far_limit, part.attributes)
    shape, dtype = (part.attributes.shape[1] + 1, TILE_SIDE**2), front.far_limit.dtype
    rows = zeros_after(inputs, (places, *shape), dtype)
    return PixelSums(rows, zeros_after(inputs, (places, TILE_SIDE**2), dtype))


def _open_pixels(
    weights: Float[Array, "places pixels"], tiles: Int[Array, " places"], part: PartSweep
) -> Bool[Array, "places pixels"]:
    """Mark the pixels in which the surface behind may be seen; tiles without a front are open."""
    of_tiles = jnp.zeros((part.grid.count, TILE_SIDE**2), weights.dtype)
    of_tiles = of_tiles.at[tiles].set(weights, mode="drop")
    return _taken(may_show_behind(of_tiles, part.grid, part.hidden_from), tiles, False)


@jit_unless_traced
def _add_sums(part: PartSweep, spans: Spans, so_far: PixelSums, first: int) -> PixelSums:
    """Add the sums over the fragments of some spans to others, from a first place on."""

    def add(i, lanes, far_limit, near_limit, so_far):
        before = _sliced(so_far, first + i, len(lanes))
        sums = jax.tree.map(jnp.add, before, part.sums(lanes, far_limit, near_limit))
        return _write(so_far, sums, first + i)

    return _each_round(part, spans.tiles, (spans.far_limit, spans.near_limit), add, so_far)


@jit_unless_traced
def _limits_behind(
    part: PartSweep, tiles: Int[Array, " places"], near_limit: Float[Array, "places pixels"]
) -> tuple[Float[Array, "places pixels"], Float[Array, "places pixels"]]:
    """Compute the end of the surface behind, for the fragments of sufficient weight and for all."""

    def look(i, lanes, near_limit, limits):
        return _write(limits, part.limits_behind(lanes, near_limit), i)

    none = zeros_after(near_limit, near_limit.shape, near_limit.dtype) - jnp.inf
    return _each_round(part, tiles, (near_limit,), look, (none, none))


def _second_limits(
    weighty: Float[Array, "places pixels"], of_any: Float[Array, "places pixels"]
) -> Float[Array, "places pixels"]:
    """Choose the end of the surface behind from the two largest limits over all parts; inf without
    a surface.
    """
    limits = jnp.where(weighty > -jnp.inf, weighty, of_any)
    return jnp.where(limits > -jnp.inf, limits, jnp.inf)


def _each_round(part: PartSweep, tiles: Int[Array, " places"], rows, function: Callable, out):
    """Apply `function(first place, lanes, *rows, out)` to the places, as many at a time as there
    are lanes, up to the last tile.
    """
    grid = part.grid

    def step(i, out):
        first = i * grid.lanes
        lanes, *arguments = _sliced((tiles, *rows), first, grid.lanes)
        return function(first, lanes, *arguments, out)

    ends = jnp.arange(1, len(tiles) + 1, dtype=jnp.int32)
    last = jnp.max(jnp.where(tiles < grid.count, ends, 0), initial=0)
    rounds, _ = divided(last + (grid.lanes - 1), grid.lanes)
    return jax.lax.fori_loop(jnp.zeros_like(rounds), rounds, step, out)


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
