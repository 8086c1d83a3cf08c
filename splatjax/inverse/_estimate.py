"""Coefficients with error bars, and what of them is not known."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from splatjax._format import channel_names, percent
from splatjax.scattering import Medium

_FIXED = 0.1
"""A combination that is known no better than this, as a relative error, counts as not fixed."""


class Combination(eqx.Module):
    r"""A product of powers, `sigma_a^p sigma_s'^q`, and how well it is known.

    **Attributes:**

    - `powers`: p and q, the larger of which is 1. Static.
    - `deviation`: standard deviation of its logarithm: its relative error, where it is small.
      Static.
    """

    powers: tuple[float, float] = eqx.field(static=True)
    deviation: float = eqx.field(static=True)

    def __str__(self) -> str:
        above = [
            _power(name, p)
            for name, p in zip(("sigma_a", "sigma_s'"), self.powers, strict=True)
            if p > 0.05
        ]
        below = [
            _power(name, -p)
            for name, p in zip(("sigma_a", "sigma_s'"), self.powers, strict=True)
            if p < -0.05
        ]
        return " ".join(above) + (f" / {' '.join(below)}" if below else "")


class Estimate(eqx.Module):
    r"""Coefficients, and how well they are known.

    **Attributes:**

    - `medium`: 1/mm.
    - `covariance`: of the logarithms of `sigma_a` and `sigma_s_prime`, channel by channel; infinite
      where nothing is known.
    """

    medium: Medium
    covariance: Float[np.ndarray, "channels 2 2"]

    def relative_errors(
        self,
    ) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Give the standard deviations of the logarithms of `sigma_a` and of `sigma_s_prime`."""
        return roots(self.covariance)

    def combinations(self) -> list[tuple[Combination, Combination]]:
        """Give, for each channel, the combination of coefficients that is known best and the one
        that is known worst.
        """
        return [best_and_worst(each) for each in self.covariance]

    def is_fixed(self) -> bool:
        """Say whether both coefficients of every channel are known to a tenth or better."""
        return all(worst.deviation <= _FIXED for _, worst in self.combinations())

    def words(self, channels: Sequence[str] | None = None) -> str:
        """Say what was found, how well, and what is not fixed.

        **Arguments:**

        - `channels`: their names; by default red, green and blue, or numbers.
        """
        return "\n".join(line for lines in self.lines(channels) for line in lines)

    def lines(self, channels: Sequence[str] | None = None) -> list[list[str]]:
        """Give what there is to say of each channel."""
        count = self.medium.eta.shape[0]
        names = channels or channel_names(count)
        found, errors = (self.medium.sigma_a, self.medium.sigma_s_prime), self.relative_errors()
        said = []
        for c, (name, (best, worst)) in enumerate(zip(names, self.combinations(), strict=True)):
            a, s = (
                f"{float(value[c]):.4g} +- {percent(error[c])}"
                for value, error in zip(found, errors, strict=True)
            )
            said.append([f"{name}: sigma_a {a}, sigma_s' {s} (1/mm)"])
            if worst.deviation > _FIXED:
                said[-1].append(
                    f"  not fixed by these pictures: {worst}, known to {percent(worst.deviation)}; "
                    f"what they fix is {best}, to {percent(best.deviation)}"
                )
        return said


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


def roots(
    covariances: Float[np.ndarray, "channels 2 2"],
) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
    """Give the deviations of both coefficients."""
    found = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return found[:, 0], found[:, 1]


def inverse(
    information: Float[np.ndarray, "unknowns unknowns"],
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Give the covariance; infinite where nothing is known."""
    lengths = np.sqrt(np.diagonal(information))
    if not np.all(np.isfinite(information)) or np.any(lengths == 0):
        return np.full_like(information, np.inf)
    values, axes = np.linalg.eigh(information / np.outer(lengths, lengths))
    # What rounding leaves of a direction in which nothing changes counts as nothing.
    values = np.maximum(values, np.finfo(np.float64).eps * len(values))
    return (axes / values) @ axes.T / np.outer(lengths, lengths)


def _power(name: str, power: float) -> str:
    return name if round(power, 2) == 1 else f"{name}^{power:.2g}"
