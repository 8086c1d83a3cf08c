"""Passes 1 to 3 of the paper: shadow maps, visibility and attributes (Eq. 1). Independent of
scattering.
"""

from ._bins import (
    bin_items as bin_items,
    Bins as Bins,
    plan_pairs as plan_pairs,
)
from ._dense import DenseRasterizer as DenseRasterizer
from ._views import (
    AbstractView as AbstractView,
    Footprints as Footprints,
    SplattingSettings as SplattingSettings,
)
from ._grid import TILE_SIDE as TILE_SIDE, TileGrid as TileGrid, TileRanges as TileRanges
from ._projections import OrthographicView as OrthographicView, PerspectiveView as PerspectiveView
from ._rasterizer import (
    AbstractRasterizer as AbstractRasterizer,
    AbstractRasterPlan as AbstractRasterPlan,
    coverage as coverage,
    fragment_weight as fragment_weight,
    FragmentSums as FragmentSums,
    invalid_factor as invalid_factor,
    PixelSums as PixelSums,
)
from ._shadows import (
    Bounds as Bounds,
    compute_visibility as compute_visibility,
    cube_views as cube_views,
    distant_view as distant_view,
    in_cube_face as in_cube_face,
    make_shadow_map as make_shadow_map,
    near_view as near_view,
    ShadowMap as ShadowMap,
    ShadowSettings as ShadowSettings,
)
from ._groups import (
    merge_splats as merge_splats,
    Sightlines as Sightlines,
    SightlineSettings as SightlineSettings,
)
from ._surfaces import (
    blend_fragments as blend_fragments,
    Surface as Surface,
    TILES_AT_ONCE as TILES_AT_ONCE,
    visible_surfaces as visible_surfaces,
    VisibleSurfaces as VisibleSurfaces,
)
from ._fragments import PartSweep as PartSweep
from ._sweeps import sum_parts as sum_parts
from ._tiles import TilePlan as TilePlan, TileRasterizer as TileRasterizer
