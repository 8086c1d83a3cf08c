"""From pictures back to optical coefficients, with error bars, and to albedo, lights, cameras and
shape.
"""

from ._background import (
    AbstractBackground as AbstractBackground,
    BlackBackground as BlackBackground,
)
from ._background import UnknownBackground as UnknownBackground
from ._descent import GradientTransformation as GradientTransformation
from ._fit_scene import fit_scene as fit_scene
from ._fitted_scene import FittedScene as FittedScene
from ._flat import wide_variances as wide_variances
from ._intensity import AbstractIntensity as AbstractIntensity, KnownIntensity as KnownIntensity
from ._intensity import UnknownColor as UnknownColor, UnknownIntensity as UnknownIntensity
from ._losses import (
    AbstractLoss as AbstractLoss,
    HuberLoss as HuberLoss,
    SquaredLoss as SquaredLoss,
)
from ._next import Candidate as Candidate, Prediction as Prediction, next_pictures as next_pictures
from ._next import default_candidates as default_candidates
from ._observation import Observation as Observation
from ._offsets import NormalOffsets as NormalOffsets
from ._parts import AbstractPart as AbstractPart, AlbedoMap as AlbedoMap, CameraPoses as CameraPoses
from ._parts import LightPlaces as LightPlaces, LightStrengths as LightStrengths
from ._recover import recover as recover
from ._estimate import Estimate as Estimate
from ._recovery import combined as combined, Recovery as Recovery
