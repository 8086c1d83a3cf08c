"""Fits of sums of Gaussians to profiles: Eq. 3 and Eq. 4."""

from ._fit import (
    error_by_count as error_by_count,
    ErrorByCount as ErrorByCount,
    fit_gaussians as fit_gaussians,
    fit_weights as fit_weights,
    FitResult as FitResult,
    LeastCount as LeastCount,
)
from ._models import (
    AbstractModel as AbstractModel,
    DiffusionModel as DiffusionModel,
    fit_medium as fit_medium,
    MediumFit as MediumFit,
    SkinModel as SkinModel,
    TransportModel as TransportModel,
    weight_factors as weight_factors,
)
from ._problem import relative_error as relative_error, squared_error as squared_error
from ._search import (
    DipoleStarts as DipoleStarts,
    GivenVariances as GivenVariances,
    AbstractSpread as AbstractSpread,
    SharedVariances as SharedVariances,
    VariancesPerChannel as VariancesPerChannel,
)
from ._table import weight_table as weight_table, WeightTable as WeightTable
from ._weights import (
    AbstractWeights as AbstractWeights,
    FixedTotalReflectance as FixedTotalReflectance,
    FreeWeights as FreeWeights,
    NonNegativeWeights as NonNegativeWeights,
)
