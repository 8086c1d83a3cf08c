"""Light transport by random walks."""

from ._incidence import AbstractIncidence as AbstractIncidence
from ._incidence import DiffuseIncidence as DiffuseIncidence, NormalIncidence as NormalIncidence
from ._monte_carlo import Estimate as Estimate, monte_carlo as monte_carlo, MonteCarlo as MonteCarlo
from ._monte_carlo import path_derivatives as path_derivatives, PathDerivatives as PathDerivatives
from ._phase import AbstractPhaseFunction as AbstractPhaseFunction
from ._phase import HenyeyGreenstein as HenyeyGreenstein, Isotropic as Isotropic
