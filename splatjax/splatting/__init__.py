"""Passes 1 to 3 of the paper: shadow maps, visibility and attributes (Eq. 1). Knows nothing of
scattering.
"""

from ._atlas import (
    Atlas as Atlas,
    farthest_depths as farthest_depths,
    TILES_AT_ONCE as TILES_AT_ONCE,
)
from ._bins import (
    BinCapacity as BinCapacity,
    bin_items as bin_items,
    Bins as Bins,
    round_up as round_up,
)
from ._bins import scatter_slots as scatter_slots, SIDE as SIDE, slot_plane as slot_plane
from ._bins import TileGrid as TileGrid, TileRanges as TileRanges
from ._dense import DenseRasterizer as DenseRasterizer
from ._kernel import coverage as coverage, fragment_weight as fragment_weight
from ._footprints import Footprints as Footprints
from ._orthographic import OrthographicView as OrthographicView
from ._perspective import PerspectiveView as PerspectiveView
from ._rasterizer import AbstractRasterizer as AbstractRasterizer, FragmentSums as FragmentSums
from ._rasterizer import SummedFragments as SummedFragments
from ._settings import SplattingSettings as SplattingSettings
from ._sharded import bounds_over as bounds_over, ShardedRasterizer as ShardedRasterizer
from ._shadows import Bounds as Bounds, cube_views as cube_views, distant_view as distant_view
from ._shadows import (
    in_cube_face as in_cube_face,
    light_surfaces as light_surfaces,
    lit_share as lit_share,
)
from ._shadows import (
    near_view as near_view,
    ShadowSettings as ShadowSettings,
    stack_views as stack_views,
)
from ._stages import gaps as gaps, Stages as Stages
from ._surfaces import blend_fragments as blend_fragments, splat_surfaces as splat_surfaces
from ._surfaces import Surface as Surface, Surfaces as Surfaces
from ._sweeps import second_limits as second_limits
from ._tiles import TileCapacity as TileCapacity, TileRasterizer as TileRasterizer
from ._views import AbstractView as AbstractView
