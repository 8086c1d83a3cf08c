"""Light transport by random walks."""

from ._monte_carlo import monte_carlo as monte_carlo
from ._results import MonteCarlo as MonteCarlo, SampleMean as SampleMean
from ._walk import (
    AbstractIncidence as AbstractIncidence,
    DiffuseIncidence as DiffuseIncidence,
    NormalIncidence as NormalIncidence,
)
