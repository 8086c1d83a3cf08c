"""Media, interfaces and reference profiles."""

from ._dipole import Dipole as Dipole
from ._fresnel import AbstractFresnel as AbstractFresnel, EganFresnel as EganFresnel, ExactFresnel as ExactFresnel
from ._medium import Medium as Medium
from ._quadrature import NORM_RULE as NORM_RULE, TOTAL_RULE as TOTAL_RULE, RadialRule as RadialRule
from ._quadrature import at_own_radii as at_own_radii, integrated_reflectance as integrated_reflectance
