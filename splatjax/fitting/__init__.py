"""From a profile to a sum of Gaussians: Eq. 3 and Eq. 4."""

from ._counts import (
    error_by_count as error_by_count,
    ErrorByCount as ErrorByCount,
    LeastCount as LeastCount,
)
from ._errors import relative_error as relative_error, squared_error as squared_error
from ._fit import fit_gaussians as fit_gaussians, FitResult as FitResult
from ._given import fit_weights as fit_weights
from ._medium import fit_medium as fit_medium, MediumFit as MediumFit
from ._search import (
    AbstractStart as AbstractStart,
    GivenVariances as GivenVariances,
    GreedyInsertion as GreedyInsertion,
)
from ._spread import (
    AbstractSpread as AbstractSpread,
    SharedVariances as SharedVariances,
    VariancesPerChannel as VariancesPerChannel,
)
from ._starts import DipoleStarts as DipoleStarts
from ._weights import (
    AbstractWeights as AbstractWeights,
    FixedTotalReflectance as FixedTotalReflectance,
    FreeWeights as FreeWeights,
    NonNegativeWeights as NonNegativeWeights,
)
