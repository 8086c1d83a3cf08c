"""From a profile to the sum of Gaussians that stands for it: Eq. 3 and Eq. 4."""

from ._counts import (
    ErrorByCount as ErrorByCount,
    LeastCount as LeastCount,
    error_by_count as error_by_count,
)
from ._errors import relative_error as relative_error, squared_error as squared_error
from ._fit import FitResult as FitResult, fit_gaussians as fit_gaussians
from ._given import fit_weights as fit_weights
from ._medium import MediumFit as MediumFit, fit_medium as fit_medium
from ._search import AbstractStart as AbstractStart
from ._search import GivenVariances as GivenVariances, InsertedGaussians as InsertedGaussians
from ._spread import AbstractSpread as AbstractSpread
from ._spread import SharedVariances as SharedVariances, VariancesPerChannel as VariancesPerChannel
from ._starts import DipoleStarts as DipoleStarts
from ._weights import AbstractWeights as AbstractWeights
from ._weights import FreeWeights as FreeWeights, NonNegativeWeights as NonNegativeWeights
from ._weights import TotalReflectanceHeld as TotalReflectanceHeld
