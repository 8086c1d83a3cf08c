"""Observations prepared for a search: which pixels count, and with which weight."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from splatjax.fitting import AbstractWeights
from splatjax.gaussians import AbstractProfile
from splatjax.render import DiffusionBasis
from splatjax.scattering import Medium

from ._flat import flatten
from ._losses import AbstractLoss
from ._observation import Observation
from ._problem import AbstractVariances, RecoveryProblem, Unknowns

_UNKNOWN_NOISE = 0.01
"""Deviation of pictures that come without one, as a fraction of their brightness: error bars do not
depend on it.
"""


class Evidence:
    """Observations as arrays of NumPy; problems have the precision of the search."""

    def __init__(self, observations: Sequence[Observation], dtype):
        self.observations, self.dtype = list(observations), dtype
        self.pictures = [np.asarray(one.picture, np.float64) for one in self.observations]
        self.masks = [
            np.all(np.isfinite(picture), axis=-1)
            & (True if one.mask is None else np.asarray(one.mask))
            for picture, one in zip(self.pictures, self.observations, strict=True)
        ]
        self.brightness = [
            float(np.sqrt(np.mean(picture[mask] ** 2))) if mask.any() else 1.0
            for picture, mask in zip(self.pictures, self.masks, strict=True)
        ]
        self.deviations = [
            np.full(picture.shape, _UNKNOWN_NOISE * (bright or 1.0))
            if one.deviation is None
            else np.broadcast_to(np.asarray(one.deviation, np.float64), picture.shape)
            for picture, bright, one in zip(
                self.pictures, self.brightness, self.observations, strict=True
            )
        ]

    @property
    def noise_is_known(self) -> bool:
        return all(one.deviation is not None for one in self.observations)

    @property
    def relative_noise(self) -> float:
        """The deviation of a typical pixel over the brightness of its picture."""
        fractions = [
            np.median(deviation) / (bright or 1.0)
            for deviation, bright in zip(self.deviations, self.brightness, strict=True)
        ]
        return float(np.mean(fractions))

    def unknowns(self, eta) -> tuple[Unknowns, int]:
        """Lay out the unknowns; also return how many factors of lights are among them."""
        rows, count, channels = [], 0, eta.shape[0]
        for one in self.observations:
            groups = one.intensity.groups(channels)
            rows.append(np.where(groups < 0, -1, groups + count))
            count += int(np.max(groups)) + 1
        factors = np.stack(rows)
        return Unknowns(
            eta, jnp.asarray(np.where(factors < 0, count, factors).astype(np.int32))
        ), count

    def problem(
        self,
        gathered: Sequence[DiffusionBasis],
        unknowns: Unknowns,
        variances: AbstractVariances,
        loss: AbstractLoss,
        weights: AbstractWeights,
        model: Callable[[Medium], AbstractProfile],
    ) -> tuple[RecoveryProblem, list[np.ndarray]]:
        """Set up the least squares problem of layers; also return the numbers of the pixels that
        count, in each picture.
        """
        flat, numbers = flatten(gathered, self.masks, self.dtype)

        def in_row(pictures):
            rows = [
                one.reshape(-1, one.shape[-1])[chosen]
                for one, chosen in zip(pictures, numbers, strict=True)
            ]
            return jnp.asarray(np.concatenate(rows).T, self.dtype)

        return RecoveryProblem(
            flat,
            in_row(self.pictures),
            in_row(self.deviations),
            unknowns,
            variances,
            loss,
            weights,
            model,
        ), numbers

    def shown(self, radiance: np.ndarray, numbers: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return pixels to their pictures; NaN where they do not count."""
        pictures, begin = [], 0
        for picture, chosen in zip(self.pictures, numbers, strict=True):
            whole = np.full((picture.shape[0] * picture.shape[1], picture.shape[2]), np.nan)
            whole[chosen] = radiance[:, begin : begin + chosen.size].T
            begin += chosen.size
            pictures.append(whole.reshape(picture.shape))
        return tuple(pictures)
