"""Results of recoveries: coefficients with error bars, and their undetermined combinations."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax._format import channel_names, percent
from splatjax._records import require
from splatjax.fitting import (
    AbstractModel,
    AbstractWeights,
    FixedTotalReflectance,
    NonNegativeWeights,
    TransportModel,
)
from splatjax.scattering import Medium
from splatjax.scene import Material

# Relative error above which a combination counts as not fixed.
_FIXED = 0.1


class Combination(eqx.Module):
    r"""A product of powers, `sigma_a^p sigma_s'^q`, and its error.

    **Attributes:**

    - `powers`: p and q; the larger is 1. Static.
    - `deviation`: standard deviation of the logarithm, which is the relative error if it is small.
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
    """Coefficients (`medium`, 1/mm) and their errors."""

    medium: Medium

    @abc.abstractmethod
    def covariance(self) -> Float[np.ndarray, "channels 2 2"]:
        """Compute the covariance of the logarithms of `sigma_a` and `sigma_s_prime` of each
        channel. It is infinite where they are unknown.
        """

    def relative_errors(
        self,
    ) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Compute the standard deviations of the logarithms of `sigma_a` and of `sigma_s_prime`."""
        deviations = np.sqrt(np.diagonal(self.covariance(), axis1=1, axis2=2))
        return deviations[:, 0], deviations[:, 1]

    def combinations(self) -> list[tuple[Combination, Combination]]:
        """Find, for each channel, the combinations of coefficients with the least and the largest
        error.
        """
        return [best_and_worst(covariance) for covariance in self.covariance()]

    def summary(self, channels: Sequence[str] | None = None) -> str:
        """Format the coefficients, their errors, and undetermined combinations.

        **Arguments:**

        - `channels`: names of the channels; by default red, green and blue, or numbers.
        """
        return "\n".join(line for lines in self.lines(channels) for line in lines)

    def lines(self, channels: Sequence[str] | None) -> list[list[str]]:
        """Format each channel, in a few lines."""
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
    """The coefficients and the covariance of their logarithms that `combined` computes."""

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
    # Scale the larger power to 1, and make the power of sigma_a positive unless it is tiny.
    axes = np.where((axes[0] > 0.05) | (axes[1] > 0.95), axes, -axes)
    deviations = np.sqrt(np.maximum(values, 0.0))
    best, worst = (
        Combination((float(a), float(s)), float(deviation))
        for (a, s), deviation in zip(axes.T, deviations, strict=True)
    )
    return best, worst


def inverse(
    information: Float[np.ndarray, "unknowns unknowns"],
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Invert information to a covariance, which is infinite for unknowns without information."""
    lengths = np.sqrt(np.diagonal(information))
    if not np.all(np.isfinite(information)) or np.any(lengths == 0):
        return np.full_like(information, np.inf)
    values, axes = np.linalg.eigh(information / np.outer(lengths, lengths))
    # Rounding gives a little spurious information along directions of no change.
    values = np.maximum(values, np.finfo(np.float64).eps * len(values))
    return (axes / values) @ axes.T / np.outer(lengths, lengths)


def _power(name: str, power: float) -> str:
    return name if round(power, 2) == 1 else f"{name}^{power:.2g}"


# Standard deviation of the logarithm of the width below which a layer is unresolved. Doubling the
# number of splats changes the logarithm by the same amount. The width is 2.5 times smaller for
# regularly spaced splats than for scattered splats.
_RESOLUTION = 0.5 * np.log(2.0)
# Chi-squared per degree of freedom above which the model counts as incomplete.
_TOO_LARGE = 1.5
# Fraction of unresolved light above which the width of the profile is hardly determined. Marble on
# a head of 100,000 splats has 0.6 and is recovered within 1.4%; the blue channel of skin has 1.0
# and is not recovered.
_MOST = 0.8


class Recovery(AbstractEstimate):
    r"""The most likely material, and its uncertainty.

        print(recovery.summary())  # coefficients, error bars, undetermined combinations
        of_sigma_a, of_sigma_s_prime = recovery.relative_errors()  # standard deviations

    **Attributes:**

    - `medium`: the coefficients, 1/mm.
    - `material`: the Gaussians with the known surface.
    - `intensities`: factors of the light of each picture; 1 where the light is known.
    - `information`: inverse of the covariance due to noise. The unknowns are the logarithms of
      `sigma_a` of each channel, of `sigma_s_prime` of each channel, of the unknown factors of the
      light, and, for each channel, of the width below which the splats do not resolve a layer.
    - `unresolved`: the fraction of the light of each channel that spreads less than the spacing of
      the splats. A picture determines the amount of this light, but not how far it travels.
    - `chi_squared`: sum of squared residuals, in units of the noise, per degree of freedom. It is
      about 1 if model and noise are right. If it is much larger, the model is incomplete and the
      error bars are too small.
    - `noise_is_known`: whether all pictures have deviations; otherwise error bars are computed from
      the residuals. Static.
    - `relative_noise`: deviation of a typical pixel divided by the brightness of its picture.
      Static.
    - `pictures`: pictures rendered with the coefficients; NaN where a pixel does not count.
    - `residuals`: rendered minus observed pictures.
    - `ends`, `costs`: the end of the search from each start in the first round, and its total loss.
    - `steps`, `rounds`: number of steps of all searches, and of rounds. Static.
    - `model`, `weights`: the model of the profile, and the constraint on the weights.
    - `result`: the outcome of the search, as a message (`optimistix.RESULTS`).

    Error bars assume that model and shape are exact and that the noise of pixels is independent;
    they describe precision, not accuracy. They include the uncertainty of unresolved layers: the
    width below which layers are unresolved is assumed known to a factor of 1.4.
    """

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
    model: AbstractModel = TransportModel()
    weights: AbstractWeights = NonNegativeWeights(FixedTotalReflectance())

    @property
    def scale(self) -> float:
        """Return the factor of the covariance due to noise."""
        return 1.0 if self.noise_is_known else float(self.chi_squared)

    def covariance(
        self,
        more: Float[np.ndarray, "all all"] | float = 0.0,
        resolution: float = _RESOLUTION,
        stretch: float = 1.0,
    ) -> Float[np.ndarray, "channels 2 2"]:
        """Compute the covariance of the logarithms of `sigma_a` and `sigma_s_prime` of each
        channel, marginalized over the other unknowns.

        It is the sum of the covariance due to noise and the square of the change of the
        coefficients if the width below which layers are unresolved changes by one standard
        deviation (`resolution`).

        **Arguments:**

        - `more`: information that another picture would add.
        - `resolution`: the standard deviation of the logarithm of that width; 0 if exact.
        - `stretch`: factor of the covariance due to noise.
        """
        channels, scale = self.medium.channels, max(self.scale * stretch, np.finfo(float).tiny)
        information = np.asarray(self.information, np.float64) / scale + more
        unknowns = len(information) - channels
        covariance = inverse(information[:unknowns, :unknowns])
        if np.all(np.isfinite(covariance)):
            # The width is not searched, so information about it does not help other unknowns.
            astray = covariance @ information[:unknowns, unknowns:] * resolution
            covariance = covariance + astray @ astray.T
        pairs = np.arange(channels)[:, None] + [0, channels]
        return covariance[pairs[:, :, None], pairs[:, None]]

    def noise_errors(self) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
        """Compute the errors due to noise alone: the scatter of the results if the pictures were
        retaken.
        """
        return Estimate(self.medium, self.covariance(resolution=0.0)).relative_errors()

    def lines(self, channels: Sequence[str] | None) -> list[list[str]]:
        lines = super().lines(channels)
        for of_channel, unresolved in zip(lines, self.unresolved.tolist(), strict=True):
            if unresolved > _MOST:
                of_channel.append(
                    f"  {percent(unresolved)} of its light spreads less than the spacing of "
                    "the splats, so its width is hardly determined; use more splats or a "
                    "closer picture"
                )
        if not self.noise_is_known:
            lines.append(["error bars are computed from the residuals, with independent pixels"])
        elif float(self.chi_squared) > _TOO_LARGE:
            noise = f"{float(self.chi_squared) ** 0.5:.2g} times the noise"
            lines.append(
                [
                    f"the residuals are {noise}; the model is incomplete, and the error bars are "
                    "too small"
                ]
            )
        return lines


def combined(recoveries: Sequence[Recovery]) -> Estimate:
    r"""Combine recoveries from separate pictures by the mean of the logarithms, weighted by their
    information.

    A search over all pictures at once weights their pixels by noise alone. Many pixels with
    unresolved layers, which do not show how far light travels, then outweigh the few that do. With
    separate searches, each picture only contributes the combination of coefficients that it
    determines: a coarse picture of a body the reflectance, a close picture under a laser dot the
    distance.

    **Arguments:**

    - `recoveries`: recoveries of one material with independent errors. If residuals exceed the
      noise, the error bars of a recovery are scaled by the square root of its `chi_squared`.

    **Returns:** an `Estimate`.

    **Raises:** `ValueError` without recoveries, and for unequal numbers of channels or indices.
    """
    require(recoveries, "recoveries is empty; give at least one")
    eta = recoveries[0].medium.eta
    for i, recovery in enumerate(recoveries):
        require(
            np.array_equal(recovery.medium.eta, eta),
            f"recoveries[{i}].medium.eta is {recovery.medium.eta.tolist()}, and that of the first "
            f"{eta.tolist()}; combine recoveries of one material",
        )
    points = np.log(
        [
            np.stack([recovery.medium.sigma_a, recovery.medium.sigma_s_prime], axis=-1)
            for recovery in recoveries
        ]
    )
    information = np.asarray([_stretched_information(recovery) for recovery in recoveries])
    covariance = np.stack([inverse(total) for total in information.sum(axis=0)])
    # Channels that no recovery determines have no weights.
    is_known = np.isfinite(covariance)
    means = np.einsum("cij,rcjk,rck->ci", np.where(is_known, covariance, 0.0), information, points)
    means = np.where(is_known.all(axis=2), means, points.mean(axis=0))
    sigma_a, sigma_s_prime = jnp.exp(jnp.asarray(means.T, eta.dtype))
    return Estimate(Medium(sigma_a, sigma_s_prime, eta), covariance)


def _stretched_information(recovery: Recovery) -> Float[np.ndarray, "channels 2 2"]:
    """Invert the covariance of each channel. Residuals above the noise count as noise."""
    stretch = max(float(recovery.chi_squared), 1.0) if recovery.noise_is_known else 1.0
    covariance = recovery.covariance(stretch=stretch)
    is_known = np.all(np.isfinite(covariance), axis=(1, 2))[:, None, None]
    return np.where(is_known, [inverse(matrix) for matrix in covariance], 0.0)
