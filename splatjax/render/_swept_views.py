"""Passes 2 and 3 of splats that come a part at a time: what each sweep finds of a part is added to
what is known of all.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax import splatting as _splatting
from splatjax.scene import Scene, Splats

Scenes: TypeAlias = Callable[[str], Iterator[Scene]]
"""Gives a scene of each part, and tells what is being done with them."""
OfTiles: TypeAlias = Float[Array, "tiles pixels"]
Gaps: TypeAlias = Bool[Array, "tiles pixels"]


class SweptView(eqx.Module):
    """A view, with room for any part."""

    view: _splatting.AbstractView
    rasterizer: _splatting.TileRasterizer
    settings: _splatting.SplattingSettings

    def stages(
        self, splats: Splats, attributes: Float[Array, "attributes splats"] | None = None
    ) -> _splatting.Stages:
        """Bin a part."""
        if attributes is None:
            attributes = jnp.zeros((0, splats.count), splats.centers.dtype)
        return _splatting.Stages.of(
            self.rasterizer.binned(splats, attributes, self.view, self.settings)
        )

    def nothing(self, attributes: int, dtype: jnp.dtype) -> _splatting.FragmentSums:
        """Give the sums of no part."""
        tiles = _splatting.TileGrid(self.view.width, self.view.height).count
        return _splatting.FragmentSums.nothing(tiles, attributes, dtype)


@dataclass(frozen=True)
class SweptViews:
    """Views, and which tiles of each any part touches: what touches none is not swept."""

    at: Sequence[SweptView]
    touched: Sequence[Bool[np.ndarray, "parts _"]]

    @classmethod
    def planned(
        cls,
        every: Scenes,
        views: Sequence[_splatting.AbstractView],
        rasterizer: _splatting.TileRasterizer,
        settings: _splatting.SplattingSettings,
    ) -> "SweptViews":
        """Find the room that any part needs."""
        demands, rows = [[] for _ in views], 0
        for scene in every("planning"):
            rows = scene.splats.count
            for view, found in zip(views, demands, strict=True):
                found.append(rasterizer.demand(scene.splats, view, settings))
        at, touched = [], []
        for view, found in zip(views, demands, strict=True):
            at.append(SweptView(view, rasterizer.with_room(found, rows, view), settings))
            tiles = _splatting.TileGrid(view.width, view.height).count
            touched.append(np.stack([np.asarray(per_tile)[:tiles] > 0 for _, per_tile in found]))
        return cls(at, touched)

    @property
    def in_the_first(self) -> list[bool]:
        """Say which parts touch the first view."""
        return [bool(tiles.any()) for tiles in self.touched[0]]

    @property
    def but_the_first(self) -> "SweptViews":
        """Give all views but the first."""
        return SweptViews(self.at[1:], self.touched[1:])

    def among(self, open_to: Iterable[Bool[Array, "_ pixels"]]) -> "SweptViews":
        """Let only tiles with some such pixels count."""
        tiles = [np.asarray(jnp.any(pixels, axis=1)) for pixels in open_to]
        return replace(
            self, touched=[own & some[None] for own, some in zip(self.touched, tiles, strict=True)]
        )

    def sweep(self, scenes: Iterator[Scene], add: Callable, *known: Sequence) -> list:
        """Let every part add to what is known, which is given last; before it what `add` needs of
        each view.
        """
        *given, found = known
        for part, scene in enumerate(scenes):
            each = zip(self.at, self.touched, zip(*given, found, strict=True), strict=True)
            found = [
                add(scene.splats, at, *own) if tiles[part].any() else own[-1]
                for at, tiles, own in each
            ]
            jax.block_until_ready(found)  # parts that are read ahead would pile up
        return list(found)


def ends_of_surfaces(
    every: Scenes, views: SweptViews, dtype: jnp.dtype
) -> tuple[list[OfTiles], list[_splatting.FragmentSums], list[OfTiles]]:
    """Find where the front ends in every view, what it weighs, and where what lies behind ends."""
    fronts = [each.nothing(0, dtype) for each in views.at]
    limits = [jnp.full_like(each.weights, -jnp.inf) for each in fronts]
    ends = [(each, each) for each in limits]
    limits = views.sweep(every("where the front ends"), _limits, limits)
    fronts = views.sweep(every("what it weighs"), _fronts, limits, fronts)
    gaps = [
        _splatting.gaps(limit, front.weights, each.settings.full_coverage)
        for limit, front, each in zip(limits, fronts, views.at, strict=True)
    ]
    ends = views.among(gaps).sweep(every("where what lies behind ends"), _ends, limits, gaps, ends)
    return limits, fronts, [_splatting.second_limits(*each) for each in ends]


def behind(
    scenes: Iterator[Scene],
    views: SweptViews,
    limits: Sequence[OfTiles],
    seconds: Sequence[OfTiles],
    dtype: jnp.dtype,
) -> list[_splatting.FragmentSums]:
    """Sum what lies behind the front in every view."""
    nothing = [each.nothing(0, dtype) for each in views.at]
    return views.among(each < jnp.inf for each in seconds).sweep(
        scenes, _behind, limits, seconds, nothing
    )


@eqx.filter_jit
def pictured(
    splats: Splats,
    attributes: Float[Array, "attributes splats"],
    at: SweptView,
    limits: OfTiles,
    seconds: OfTiles,
    so_far: tuple[_splatting.FragmentSums, _splatting.FragmentSums],
) -> tuple[_splatting.FragmentSums, _splatting.FragmentSums]:
    """Add what a part shows, of both surfaces."""
    stages = at.stages(splats, attributes)
    return jax.tree.map(jnp.add, so_far, (stages.front(limits), stages.behind(limits, seconds)))


@eqx.filter_jit
def blended(
    at: SweptView, front: _splatting.FragmentSums, behind: _splatting.FragmentSums
) -> _splatting.Surfaces:
    """Blend both surfaces."""
    both = (_splatting.Surface.of(sums, at.view, at.settings) for sums in (front, behind))
    return _splatting.Surfaces(*both, jnp.zeros((), front.weights.dtype))


@eqx.filter_jit
def _limits(splats: Splats, at: SweptView, so_far: OfTiles) -> OfTiles:
    return jnp.maximum(so_far, at.stages(splats).limits())


@eqx.filter_jit
def _fronts(
    splats: Splats, at: SweptView, limits: OfTiles, so_far: _splatting.FragmentSums
) -> _splatting.FragmentSums:
    return jax.tree.map(jnp.add, so_far, at.stages(splats).front(limits))


@eqx.filter_jit
def _ends(
    splats: Splats, at: SweptView, limits: OfTiles, gaps: Gaps, so_far: tuple[OfTiles, OfTiles]
) -> tuple[OfTiles, OfTiles]:
    return jax.tree.map(jnp.maximum, so_far, at.stages(splats).limits_behind(limits, gaps))


@eqx.filter_jit
def _behind(
    splats: Splats,
    at: SweptView,
    limits: OfTiles,
    seconds: OfTiles,
    so_far: _splatting.FragmentSums,
) -> _splatting.FragmentSums:
    return jax.tree.map(jnp.add, so_far, at.stages(splats).behind(limits, seconds))
