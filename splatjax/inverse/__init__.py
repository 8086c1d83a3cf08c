"""Recovery of optical coefficients from pictures, with error bars, and of maps of material
parameters, albedo, lights, cameras and shape.
"""

from ._fit_scene import fit_scene as fit_scene
from ._fitted_scene import FittedScene as FittedScene, randomized_fits as randomized_fits
from ._observation import (
    AbstractBackground as AbstractBackground,
    BlackBackground as BlackBackground,
    UnknownBackground as UnknownBackground,
    AbstractLoss as AbstractLoss,
    HuberLoss as HuberLoss,
    SquaredLoss as SquaredLoss,
    AbstractIntensity as AbstractIntensity,
    KnownIntensity as KnownIntensity,
    UnknownColor as UnknownColor,
    UnknownIntensity as UnknownIntensity,
    Candidate as Candidate,
    default_candidates as default_candidates,
    Observation as Observation,
    PicturedScene as PicturedScene,
)
from ._parts import (
    AbstractPart as AbstractPart,
    AlbedoMap as AlbedoMap,
    CameraPoses as CameraPoses,
    LightPlaces as LightPlaces,
    LightStrengths as LightStrengths,
)
from ._problem import wide_variances as wide_variances
from ._recover import (
    next_pictures as next_pictures,
    Prediction as Prediction,
    recover as recover,
)
from ._recovery import combined as combined, Estimate as Estimate, Recovery as Recovery
from ._surface_maps import NormalOffsets as NormalOffsets, ParameterMap as ParameterMap
