"""Media, interfaces, layers and reference profiles."""

from ._better_dipole import BetterDipole as BetterDipole
from ._burley import AbstractBurleyScaling as AbstractBurleyScaling, Burley as Burley
from ._burley import (
    DiffuseMeanFreePath as DiffuseMeanFreePath,
    DiffuseTransmission as DiffuseTransmission,
)
from ._burley import Searchlight as Searchlight
from ._dipole import Dipole as Dipole
from ._fresnel import (
    AbstractFresnel as AbstractFresnel,
    EganFresnel as EganFresnel,
    ExactFresnel as ExactFresnel,
)
from ._fresnel import moment_outside as moment_outside
from ._hankel import (
    hankel_transform as hankel_transform,
    inverse_hankel_transform as inverse_hankel_transform,
)
from ._laser_dot import LaserDot as LaserDot, measure_laser_dot as measure_laser_dot
from ._layered import LayeredMultipole as LayeredMultipole
from ._layers import Film as Film, Layer as Layer
from ._medium import check_range as check_range, Medium as Medium
from ._multipole import Multipole as Multipole
from ._photon_beam import PhotonBeam as PhotonBeam
from ._quadrature import (
    AbstractRadialRule as AbstractRadialRule,
    InverseVariance as InverseVariance,
)
from ._quadrature import NORM_RULE as NORM_RULE, TOTAL_RULE as TOTAL_RULE, RadialRule as RadialRule
from ._quadrature import (
    at_own_radii as at_own_radii,
    integrated_reflectance as integrated_reflectance,
)
from ._rough import RoughFresnel as RoughFresnel
from ._single_scattering import SingleScattering as SingleScattering
from ._slab import AbstractSlabProfile as AbstractSlabProfile, Transmitted as Transmitted
from ._tabulated import Tabulated as Tabulated
