"""What was recovered, and how well it is known."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax.scattering import Medium
from splatjax.scene import Material

_FIXED = 0.1
"""A combination that is known no better than this, as a relative error, counts as not fixed."""
_HANDOVER = 0.5 * math.log(2.0)
"""How well the width is known, as a logarithm, below which layers are handed to the surface: twice as many splats move it by as
much, and that of regular ones lies a factor of 2.5 below that of scattered ones."""


class Combination(eqx.Module):
    r"""A product of powers, `sigma_a^p sigma_s'^q`, and how well it is known.

    **Attributes:**

    - `powers`: p and q, the larger of which is 1. Static.
    - `deviation`: standard deviation of its logarithm: its relative error, where it is small. Static.
    """

    powers: tuple[float, float] = eqx.field(static=True)
    deviation: float = eqx.field(static=True)

    def __str__(self) -> str:
        above = [_power(name, p) for name, p in zip(("sigma_a", "sigma_s'"), self.powers, strict=True) if p > 0.05]
        below = [_power(name, -p) for name, p in zip(("sigma_a", "sigma_s'"), self.powers, strict=True) if p < -0.05]
        return " ".join(above) + (f" / {' '.join(below)}" if below else "")


class Recovery(eqx.Module):
    r"""The most likely material, and what the pictures tell of it.

    **Attributes:**

    - `medium`: its coefficients, 1/mm.
    - `material`: its Gaussians, and the surface that was taken as known.
    - `intensities`: factors on the light of each picture that were found; 1 where it was known.
    - `information`: inverse of the covariance that the given noise leaves: of the logarithms of `sigma_a`, channel by channel, of
      those of `sigma_s_prime`, of the factors that were to be found, and, channel by channel, of the width below which a layer is
      handed to the surface, because the splats are too far apart to carry it.
    - `unresolved`: the share of the light of each channel that spreads less than the splats are apart. A picture shows how much
      of it there is, not how far it goes.
    - `chi_squared`: what the model leaves over, squared, over the noise, per degree of freedom. About 1 where model and noise are
      right; far above, the model lacks something, and error bars are too small.
    - `noise_is_known`: whether all pictures came with deviations; where not, error bars are those of what is left over. Static.
    - `relative_noise`: deviation of a typical pixel over the brightness of its picture. Static.
    - `pictures`: what the model makes of the coefficients; NaN where a pixel does not count.
    - `residuals`: pictures less what was observed.
    - `ends`, `costs`: where the search from each start ended in the first round, and the sum of its losses.
    - `steps`, `rounds`: of all searches. Static.
    - `result`: what became of it, as a message (`optimistix.RESULTS`).

    Error bars assume that model and shape are right and that the noise of pixels is independent: they are of precision, not of
    truth. That a layer narrower than the splats looks as the renderer makes it look is not assumed: the width of that handover
    counts as known to a factor of 1.4, and how far the search would go astray with it is part of the bars.
    """

    medium: Medium
    material: Material
    intensities: Float[Array, "pictures channels"]
    information: Float[Array, "all all"]
    unresolved: Float[Array, " channels"]
    chi_squared: Float[Array, ""]
    pictures: tuple[Float[np.ndarray, "_ _ channels"], ...]
    residuals: tuple[Float[np.ndarray, "_ _ channels"], ...]
    ends: tuple[Medium, ...]
    costs: Float[Array, " starts"]
    result: optx.RESULTS
    noise_is_known: bool = eqx.field(static=True)
    relative_noise: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    rounds: int = eqx.field(static=True)

    @property
    def scale(self) -> float:
        """What the covariance of the given noise is to be multiplied by."""
        return 1.0 if self.noise_is_known else float(self.chi_squared)

    def covariance(self, more: Float[np.ndarray, "all all"] | None = None) -> Float[np.ndarray, "channels 2 2"]:
        """Give, for each channel, that of the logarithms of `sigma_a` and `sigma_s_prime`, whatever the other unknowns are.

        What noise leaves, and the square of how far the handover's width, off by its deviation, would lead the search astray.

        **Arguments:**

        - `more`: information that another picture would add.
        """
        told = self._told() if more is None else self._told() + more
        unknowns = len(told) - self.medium.eta.shape[0]
        noise = inverse(told[:unknowns, :unknowns])
        if not np.all(np.isfinite(noise)):
            return self._of_pairs(noise)
        # The width is not searched: where pictures tell of it, they tell it to nobody.
        astray = noise @ told[:unknowns, unknowns:] * _HANDOVER
        return self._of_pairs(noise + astray @ astray.T)

    def covariance_of_noise(self) -> Float[np.ndarray, "channels 2 2"]:
        """Give the covariance as if the renderer were right about layers narrower than the splats: what noise alone leaves."""
        unknowns = len(self.information) - self.medium.eta.shape[0]
        return self._of_pairs(inverse(self._told()[:unknowns, :unknowns]))

    def _told(self) -> Float[np.ndarray, "all all"]:
        return np.asarray(self.information, np.float64) / max(self.scale, np.finfo(np.float64).tiny)

    def _of_pairs(self, whole: Float[np.ndarray, "some some"]) -> Float[np.ndarray, "channels 2 2"]:
        channels = self.medium.eta.shape[0]
        return np.stack([whole[np.ix_([c, channels + c], [c, channels + c])] for c in range(channels)])

    def relative_errors(self) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Give the standard deviations of the logarithms of `sigma_a` and of `sigma_s_prime`."""
        return _roots(self.covariance())

    def noise_errors(self) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Give those of `covariance_of_noise`: how far a search would scatter if the picture were taken again."""
        return _roots(self.covariance_of_noise())

    def combinations(self) -> list[tuple[Combination, Combination]]:
        """Give, for each channel, the combination of coefficients that is known best and the one that is known worst."""
        return [best_and_worst(each) for each in self.covariance()]

    def is_fixed(self) -> bool:
        """Say whether the pictures fix both coefficients of every channel, to a tenth or better."""
        return all(worst.deviation <= _FIXED for _, worst in self.combinations())

    def words(self, channels: Sequence[str] | None = None) -> str:
        """Say what was found, how well, and what the pictures do not fix.

        **Arguments:**

        - `channels`: their names; by default red, green and blue, or numbers.
        """
        count = self.medium.eta.shape[0]
        names = channels or (("red", "green", "blue") if count == 3 else [f"channel {c + 1}" for c in range(count)])
        errors = self.relative_errors()
        lines = []
        for c, (name, (best, worst)) in enumerate(zip(names, self.combinations(), strict=True)):
            found = np.asarray(self.medium.sigma_a)[c], np.asarray(self.medium.sigma_s_prime)[c]
            a, s = (f"{float(value):.4g} +- {percent(error[c])}" for value, error in zip(found, errors, strict=True))
            lines.append(f"{name}: sigma_a {a}, sigma_s' {s} (1/mm)")
            if worst.deviation > _FIXED:
                lines.append(
                    f"  not fixed by these pictures: {worst}, known to {percent(worst.deviation)}; "
                    f"what they fix is {best}, to {percent(best.deviation)}"
                )
            unresolved = float(np.asarray(self.unresolved)[c])
            if unresolved > _MOST:
                lines.append(
                    f"  {percent(unresolved)} of its light spreads less than the splats are apart: how far, they can hardly "
                    "show; take more splats, or a smaller piece from closer up"
                )
        if not self.noise_is_known:
            lines.append("error bars are those of what the model leaves over, as if its pixels were independent")
        elif float(self.chi_squared) > _TOO_LARGE:
            lines.append(
                f"the model leaves {float(self.chi_squared) ** 0.5:.2g} times the noise: it lacks something, and the error bars "
                "are too small"
            )
        return "\n".join(lines)


_TOO_LARGE = 1.5
_MOST = 0.8
"""Of the light: marble on a head of 100,000 splats has 0.6 and comes back within 1.4%, the blue of skin 1.0 and does not."""


def best_and_worst(covariance: Float[np.ndarray, "2 2"]) -> tuple[Combination, Combination]:
    """Give the principal axes of a covariance of logarithms."""
    if not np.all(np.isfinite(covariance)):
        return Combination((1.0, 0.0), np.inf), Combination((0.0, 1.0), np.inf)
    values, axes = np.linalg.eigh(covariance)
    found = []
    for value, axis in zip(values, axes.T, strict=True):
        axis = axis / axis[np.argmax(np.abs(axis))]
        axis = axis if axis[0] > 0.05 or axis[1] > 0.95 else -axis
        found.append(Combination((float(axis[0]), float(axis[1])), float(np.sqrt(max(value, 0.0)))))
    return found[0], found[1]


def _roots(
    covariances: Float[np.ndarray, "channels 2 2"],
) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
    roots = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return roots[:, 0], roots[:, 1]


def inverse(information: Float[np.ndarray, "unknowns unknowns"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """Give the covariance; infinite where nothing is known."""
    lengths = np.sqrt(np.diagonal(information))
    if not np.all(np.isfinite(information)) or np.any(lengths == 0):
        return np.full_like(information, np.inf)
    values, axes = np.linalg.eigh(information / np.outer(lengths, lengths))
    # What rounding leaves of a direction in which nothing changes counts as nothing.
    values = np.maximum(values, np.finfo(np.float64).eps * len(values))
    return (axes / values) @ axes.T / np.outer(lengths, lengths)


def percent(share: float) -> str:
    """Write a relative error."""
    return "anything" if not np.isfinite(share) or share > 10 else f"{float(f'{100 * share:.2g}'):g}%"


def _power(name: str, power: float) -> str:
    return name if round(power, 2) == 1 else f"{name}^{power:.2g}"
