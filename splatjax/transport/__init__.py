"""Light transport by random walks."""

from ._directions import (
    AbstractIncidence as AbstractIncidence,
    AbstractPhaseFunction as AbstractPhaseFunction,
    DiffuseIncidence as DiffuseIncidence,
    HenyeyGreenstein as HenyeyGreenstein,
    Isotropic as Isotropic,
    NormalIncidence as NormalIncidence,
)
from ._monte_carlo import monte_carlo as monte_carlo, path_derivatives as path_derivatives
from ._results import (
    MonteCarlo as MonteCarlo,
    PathDerivatives as PathDerivatives,
    SampleMean as SampleMean,
)
