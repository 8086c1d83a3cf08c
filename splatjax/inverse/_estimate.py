"""Coefficients with error bars, and which of their combinations are unknown."""

import abc
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from splatjax._format import channel_names, percent
from splatjax.scattering import Medium

_FIXED = 0.1
"""A combination with a larger relative error counts as not fixed."""


class Combination(eqx.Module):
    r"""A product of powers, `sigma_a^p sigma_s'^q`, and its error.

    **Attributes:**

    - `powers`: p and q, the larger of which is 1. Static.
    - `deviation`: standard deviation of its logarithm: its relative error, where it is small.
      Static.
    """

    powers: tuple[float, float] = eqx.field(static=True)
    deviation: float = eqx.field(static=True)

    def __str__(self) -> str:
        terms = tuple(zip(("sigma_a", "sigma_s'"), self.powers, strict=True))
        above = " ".join(_power(name, power) for name, power in terms if power > 0.05)
        below = " ".join(_power(name, -power) for name, power in terms if power < -0.05)
        return f"{above} / {below}" if below else above


class AbstractEstimate(eqx.Module):
    """Coefficients, `medium` (1/mm), and their errors."""

    medium: eqx.AbstractVar[Medium]

    @abc.abstractmethod
    def covariance(self) -> Float[np.ndarray, "channels 2 2"]:
        """Return the covariance of the logarithms of `sigma_a` and `sigma_s_prime` of each channel;
        infinite where they are unknown.
        """

    def relative_errors(
        self,
    ) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Compute the standard deviations of the logarithms of `sigma_a` and of `sigma_s_prime`."""
        return roots(self.covariance())

    def combinations(self) -> list[tuple[Combination, Combination]]:
        """Find, for each channel, the combination of coefficients with the least error and the one
        with the largest.
        """
        return [best_and_worst(covariance) for covariance in self.covariance()]

    def is_fixed(self) -> bool:
        """Return whether both coefficients of every channel are known to a tenth or better."""
        return all(worst.deviation <= _FIXED for _, worst in self.combinations())

    def summary(self, channels: Sequence[str] | None = None) -> str:
        """Format the coefficients, their errors, and the combinations that are not fixed.

        **Arguments:**

        - `channels`: their names; by default red, green and blue, or numbers.
        """
        return "\n".join(line for lines in self.lines(channels) for line in lines)

    def lines(self, channels: Sequence[str] | None = None) -> list[list[str]]:
        """Format each channel, in one line or two."""
        names = channels or channel_names(self.medium.channels)
        values, errors = (self.medium.sigma_a, self.medium.sigma_s_prime), self.relative_errors()
        lines = []
        for c, (name, (best, worst)) in enumerate(zip(names, self.combinations(), strict=True)):
            a, s = (
                f"{float(value[c]):.4g} +- {percent(error[c])}"
                for value, error in zip(values, errors, strict=True)
            )
            lines.append([f"{name}: sigma_a {a}, sigma_s' {s} (1/mm)"])
            if worst.deviation > _FIXED:
                lines[-1].append(
                    f"  not fixed by these pictures: {worst}, known to {percent(worst.deviation)}; "
                    f"they fix {best} to {percent(best.deviation)}"
                )
        return lines


class Estimate(AbstractEstimate):
    """Coefficients and the covariance of their logarithms, as `combined` returns them."""

    medium: Medium
    covariance_of_logarithms: Float[np.ndarray, "channels 2 2"]

    def covariance(self) -> Float[np.ndarray, "channels 2 2"]:
        return self.covariance_of_logarithms


def best_and_worst(covariance: Float[np.ndarray, "2 2"]) -> tuple[Combination, Combination]:
    """Find the principal axes of a covariance of logarithms."""
    if not np.all(np.isfinite(covariance)):
        return Combination((1.0, 0.0), np.inf), Combination((0.0, 1.0), np.inf)
    values, axes = np.linalg.eigh(covariance)
    largest = np.take_along_axis(axes, np.argmax(np.abs(axes), axis=0)[None], axis=0)
    axes = axes / largest
    # The larger power is 1, and that of sigma_a is positive unless it is next to nothing.
    axes = np.where((axes[0] > 0.05) | (axes[1] > 0.95), axes, -axes)
    deviations = np.sqrt(np.maximum(values, 0.0))
    best, worst = (
        Combination((float(a), float(s)), float(deviation))
        for (a, s), deviation in zip(axes.T, deviations, strict=True)
    )
    return best, worst


def roots(
    covariances: Float[np.ndarray, "channels 2 2"],
) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
    """Compute the standard deviations of both coefficients."""
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return deviations[:, 0], deviations[:, 1]


def inverse(
    information: Float[np.ndarray, "unknowns unknowns"],
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Invert information to a covariance; infinite where an unknown has no information."""
    lengths = np.sqrt(np.diagonal(information))
    if not np.all(np.isfinite(information)) or np.any(lengths == 0):
        return np.full_like(information, np.inf)
    values, axes = np.linalg.eigh(information / np.outer(lengths, lengths))
    # Rounding leaves a little information along directions in which nothing changes.
    values = np.maximum(values, np.finfo(np.float64).eps * len(values))
    return (axes / values) @ axes.T / np.outer(lengths, lengths)


def _power(name: str, power: float) -> str:
    return name if round(power, 2) == 1 else f"{name}^{power:.2g}"
