"""Media, interfaces, layers and reference profiles."""

from ._dipole import (
    AbstractDipole as AbstractDipole,
    AbstractHalfSpace as AbstractHalfSpace,
    BetterDipole as BetterDipole,
    Burley as Burley,
    diffuse_mean_free_path_scaling as diffuse_mean_free_path_scaling,
    diffuse_scaling as diffuse_scaling,
    Dipole as Dipole,
    searchlight_scaling as searchlight_scaling,
)
from ._half_space import (
    ANGULAR_POWERS as ANGULAR_POWERS,
    AngularLaw as AngularLaw,
    HalfSpace as HalfSpace,
)
from ._medium import (
    AbstractFresnel as AbstractFresnel,
    check_stack as check_stack,
    EganFresnel as EganFresnel,
    ExactFresnel as ExactFresnel,
    Film as Film,
    Layer as Layer,
    Medium as Medium,
    moment_outside as moment_outside,
    reflectance as reflectance,
)
from ._photon_beam import PhotonBeam as PhotonBeam, SingleScattering as SingleScattering
from ._quadrature import (
    AbstractRadialRule as AbstractRadialRule,
    at_own_radii as at_own_radii,
    integrated_reflectance as integrated_reflectance,
    inverse_hankel_transform as inverse_hankel_transform,
    InverseVariance as InverseVariance,
    L1_QUADRATURE as L1_QUADRATURE,
    L2_QUADRATURE as L2_QUADRATURE,
    RadialRule as RadialRule,
)
from ._projected import Projected as Projected
from ._skin import Skin as Skin, SkinProfile as SkinProfile
from ._slab import (
    AbstractSlabProfile as AbstractSlabProfile,
    LayeredMultipole as LayeredMultipole,
    Multipole as Multipole,
    Transmitted as Transmitted,
)
from ._tabulated import (
    LaserDot as LaserDot,
    measure_laser_dot as measure_laser_dot,
    Tabulated as Tabulated,
)
