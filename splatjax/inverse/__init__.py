"""Optical coefficients from pictures, with error bars; also albedo, lights, cameras and shape."""

from ._candidates import (
    Candidate as Candidate,
    default_candidates as default_candidates,
    next_pictures as next_pictures,
    Prediction as Prediction,
)
from ._fit_scene import (
    fit_scene as fit_scene,
    FittedScene as FittedScene,
    GradientTransformation as GradientTransformation,
)
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
    Observation as Observation,
)
from ._offsets import NormalOffsets as NormalOffsets
from ._parts import (
    AbstractPart as AbstractPart,
    AlbedoMap as AlbedoMap,
    CameraPoses as CameraPoses,
    LightPlaces as LightPlaces,
    LightStrengths as LightStrengths,
)
from ._problem import wide_variances as wide_variances
from ._recover import recover as recover
from ._recovery import combined as combined, Estimate as Estimate, Recovery as Recovery
