"""Pass 4 of the paper: splat-based diffusion in object space."""

from ._points import (
    continue_from_splats as continue_from_splats,
    continue_to_points as continue_to_points,
    LayersAtPoints as LayersAtPoints,
)
from ._clustered import (
    ClusterDiffuser as ClusterDiffuser,
    ClusterPlan as ClusterPlan,
    FINE_QUANTILE as FINE_QUANTILE,
)
from ._dense import (
    dense_layer as dense_layer,
    dense_layers as dense_layers,
    DenseDiffuser as DenseDiffuser,
)
from ._diffuser import (
    AbstractDiffuser as AbstractDiffuser,
    AbstractDiffusionPlan as AbstractDiffusionPlan,
    Beams as Beams,
    Diffused as Diffused,
    LayerValues as LayerValues,
    Sources as Sources,
)
from ._exitance import ExitanceDiffuser as ExitanceDiffuser, ExitancePlan as ExitancePlan
from ._kernel import (
    AbstractDiffusionKernel as AbstractDiffusionKernel,
    EscapeNormalization as EscapeNormalization,
    PlainMean as PlainMean,
    resolved_fraction as resolved_fraction,
    unevenness as unevenness,
)
from ._shape import ShapeDiffuser as ShapeDiffuser, ShapePlan as ShapePlan
from ._streamed import streamed_layers as streamed_layers
from ._clusters import POINTS_PER_BLOCK as POINTS_PER_BLOCK, compact_order as compact_order
