"""Pass 4 of the paper: splat-based diffusion in object space."""

from ._clustered import ClusterDiffuser as ClusterDiffuser, FINEST as FINEST
from ._dense import DenseDiffuser as DenseDiffuser
from ._diffuser import AbstractDiffuser as AbstractDiffuser, Diffused as Diffused
from ._diffuser import Kernels as Kernels, Sources as Sources
from ._gathered import (
    Gather as Gather,
    gather_light as gather_light,
    gather_light_and_slopes as gather_light_and_slopes,
)
from ._gathered import GatheredLight as GatheredLight, GatheredSlopes as GatheredSlopes
from ._handover import handover_interval as handover_interval, irregularity as irregularity
from ._handover import PLACES as PLACES, resolved_share as resolved_share
from ._irradiance import entering_irradiance as entering_irradiance
from ._layers import (
    diffusion_layers as diffusion_layers,
    DiffusionLayers as DiffusionLayers,
    layers_of as layers_of,
)
from ._layers import exitance_jacobian as exitance_jacobian, ExitanceJacobian as ExitanceJacobian
from ._normalization import (
    AbstractNormalization as AbstractNormalization,
    ExitOdds as ExitOdds,
    PlainMean as PlainMean,
)
from ._points import Points as Points, SeenSurface as SeenSurface
from ._settings import DiffusionSettings as DiffusionSettings
from ._pixels import Pixels as Pixels
from ._streamed import StreamedRoom as StreamedRoom, StreamedSums as StreamedSums
from ._sharded import ShardedDiffuser as ShardedDiffuser
