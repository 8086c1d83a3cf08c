"""Light transport by random walks."""

from ._incidence import (
    AbstractIncidence as AbstractIncidence,
    DiffuseIncidence as DiffuseIncidence,
    NormalIncidence as NormalIncidence,
)
from ._monte_carlo import monte_carlo as monte_carlo, path_derivatives as path_derivatives
from ._phase import (
    AbstractPhaseFunction as AbstractPhaseFunction,
    HenyeyGreenstein as HenyeyGreenstein,
    Isotropic as Isotropic,
)
from ._results import (
    MonteCarlo as MonteCarlo,
    PathDerivatives as PathDerivatives,
    SampleMean as SampleMean,
)
