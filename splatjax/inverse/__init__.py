"""From pictures of a known shape back to optical coefficients, with error bars."""

from ._flat import wide_variances as wide_variances
from ._intensity import AbstractIntensity as AbstractIntensity, KnownIntensity as KnownIntensity
from ._intensity import UnknownColor as UnknownColor, UnknownIntensity as UnknownIntensity
from ._losses import AbstractLoss as AbstractLoss, HuberLoss as HuberLoss, SquaredLoss as SquaredLoss
from ._next import Candidate as Candidate, Prediction as Prediction, next_pictures as next_pictures
from ._next import usual_candidates as usual_candidates
from ._observation import Observation as Observation
from ._recover import recover as recover
from ._recovery import Recovery as Recovery
