"""Models that compute profiles and angular laws from media, and fits of optical coefficients to a
measured profile.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax._records import as_floats, check_values, numbers, require
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import (
    L2_QUADRATURE,
    AbstractRadialRule,
    AngularLaw,
    Dipole,
    HalfSpace,
    Medium,
    PhotonBeam,
    Projected,
    Skin,
    Tabulated,
)

from ._fit import fit_gaussians, fit_weights
from ._search import VariancesPerChannel
from ._weights import FixedTotalReflectance, NonNegativeWeights, NormalEquations, invert

_TOLERANCE = 1e-7
_STEPS = 64


class AbstractModel(eqx.Module):
    """A model of light in a half space.

    **Attributes:** (of the class)

    - `rule`: the quadrature for fits to its profiles.
    - `description`: describes the profile in files; `None` if the coefficients alone define it.
    """

    rule: ClassVar[AbstractRadialRule] = L2_QUADRATURE
    description: ClassVar[str | None] = None

    @abc.abstractmethod
    def profile(self, medium: Any) -> AbstractProfile:
        """Compute the profile of a medium, or for `SkinModel` of a `Skin`. Differentiable."""

    def angles(self, medium: Any) -> AngularLaw | None:
        """Compute the dependence of light on the angles of entry and exit; `None` if there is
        none.
        """
        return None


class DiffusionModel(AbstractModel):
    r"""A model with a closed-form profile: `Dipole`, which most publications use, or
    `BetterDipole`.

    **Attributes:**

    - `kind`: computes the profile of a medium; it must be finite at the origin. Static.
    """

    kind: Callable[[Medium], AbstractProfile] = eqx.field(static=True, default=Dipole)

    def profile(self, medium: Medium) -> AbstractProfile:
        return self.kind(medium)


class TransportModel(AbstractModel):
    r"""The default model: the photon beam profile, with the total reflectance and the angular law
    of light transport (`HalfSpace`).

        model = TransportModel(g=0.8)
        weights = NonNegativeWeights(FixedTotalReflectance())
        fitted = fit_gaussians(model.profile(medium), weights=weights, rule=model.rule)
        material = Material(fitted.gaussians, eta=1.3, angles=model.angles(medium))

    `g` affects the total, the angular law and single scattering; the shape of multiple scattering
    is that of isotropic scattering.

    `rule` starts at half a mean free path, because splats hardly resolve smaller radii. It weights
    radii by their fifth power, so that the fit is accurate deep inside a shadow.

    **Attributes:**

    - `g`: mean cosine of the phase function, one number or one per channel. Differentiable. Give an
      array to avoid recompiling jitted functions for each new number.
    """

    g: float | tuple[float, ...] | Float[Array, "..."] = 0.0

    rule: ClassVar[AbstractRadialRule] = L2_QUADRATURE.beyond(0.5, tail=4.0)
    description: ClassVar[str | None] = "photon beam with the total of light transport"

    def half_space(self, medium: Medium) -> HalfSpace:
        return HalfSpace(medium, self.g)

    def profile(self, medium: Medium) -> PhotonBeam:
        space = self.half_space(medium)
        # Henyey and Greenstein's phase function backwards, over isotropic scattering with the
        # reduced coefficient; for negative g, a fit to light transport.
        single = jnp.where(space.g > 0, 1 / (1 + space.g), 1 - space.g) ** 2
        return PhotonBeam(medium, single=single).with_total(space.total_reflectance())

    def angles(self, medium: Medium) -> AngularLaw:
        return self.half_space(medium).angular_law()


class SkinModel(AbstractModel):
    r"""A model of skin, computed from its pigments: profile and angular law by light transport, in
    red, green and blue.

        skin = Skin(melanin=0.03)
        model = SkinModel(io.spectrum_to_rgb(skin.wavelengths))
        fitted = fit_gaussians(model.profile(skin), weights=weights, rule=model.rule)

    **Attributes:**

    - `matrix`: converts the wavelengths of the skin to red, green and blue. Differentiable.
    """

    matrix: Float[Array, "wavelengths colors"] = eqx.field(converter=numbers)

    rule: ClassVar[AbstractRadialRule] = TransportModel.rule
    description: ClassVar[str | None] = (
        "photon beams of dermis and epidermis with the total of light transport, as sRGB"
    )

    def profile(self, medium: Skin) -> Projected:
        return Projected(medium.profile(), self.matrix)

    def angles(self, medium: Skin) -> AngularLaw:
        total = medium.profile().total_reflectance()
        return medium.half_space().angular_law().projected(total, self.matrix)


def weight_factors(
    gaussians: SumOfGaussians, other: AbstractProfile
) -> Float[Array, "gaussians channels"]:
    """Fit factors that convert the weights of one material to those of another.

        factors = weight_factors(light.gaussians, dark.gaussians)
        splats = replace(splats, weights=1 + share[:, None, None] * (factors - 1))

    The variances are unchanged, so one picture can show both materials: `Splats.weights` is 1 where
    the body consists of the first material, and `factors` where it consists of the second. The
    total reflectance of the second is exact, and no weight is negative.

    **Arguments:** (concrete arrays: call the function outside of `jit` and `grad`)

    - `gaussians`: the Gaussians of the first material. A weight of 0 stays 0, so choose the
      material with the wider profile.
    - `other`: the profile of the second material, 1/mm^2.

    **Returns:** one factor for each Gaussian and channel; 1 in a channel without weights.

    **Raises:** `ValueError` for negative weights, and for unequal numbers of channels.
    """
    weights = np.asarray(gaussians.weights)
    channels = other.length_scale().size
    require(
        channels == gaussians.channels,
        f"other has {channels} channels, gaussians have {gaussians.channels}; give equal numbers",
    )
    remedy = "at least 0; fit them with NonNegativeWeights(FixedTotalReflectance())"
    check_values("gaussians.weights", weights, remedy, lambda x: x >= 0)
    factors, has_weight = np.ones_like(weights), weights > 0
    for used in np.unique(has_weight[:, has_weight.any(axis=0)], axis=1).T:
        alike = np.ix_(used, np.all(has_weight == used[:, None], axis=0))
        fitted = np.ones_like(weights)
        fitted[used] = _fit_held(other, gaussians.variances[used])
        factors[alike] = fitted[alike] / weights[alike]
    return jnp.asarray(factors)


@eqx.filter_jit
def _fit_held(profile: AbstractProfile, variances: Float[Array, " gaussians"]):
    """Fit non-negative weights whose sum is the profile's total reflectance."""
    return fit_weights(
        profile,
        variances,
        weights=NonNegativeWeights(FixedTotalReflectance()),
        rule=TransportModel.rule,
    ).weights


class MediumFit(eqx.Module):
    r"""A medium fitted to a measured profile, and its covariance.

    **Attributes:**

    - `medium`: the most likely medium.
    - `covariance`: covariance of the logarithms of `sigma_a` and `sigma_s_prime` per channel; its
      diagonal contains the squared relative errors.
    - `chi_squared`: sum of squared residuals, in units of the deviations, per degree of freedom. It
      is about 1 if model and deviations are right; if it is larger, multiply the error bars by its
      square root.
    - `result`: the outcome of the search, as a message (`optimistix.RESULTS`).
    """

    medium: Medium
    covariance: Float[Array, "channels 2 2"]
    chi_squared: Float[Array, " channels"]
    result: optx.RESULTS


def fit_medium(
    measured: Tabulated,
    start: Medium,
    *,
    beam_variance: float = 0.0,
    model: Callable[[Medium], AbstractProfile] = Dipole,
    count: int = 6,
    throw: bool = True,
) -> MediumFit:
    r"""Fit absorption and scattering to the samples of a measured profile by weighted least
    squares.

    The profile of the coefficients is replaced by its sum of Gaussians, as in pictures, and the
    variance of the beam is added to each Gaussian. The fit of the Gaussians is differentiated too.
    Channels are independent. Use double precision.

    **Arguments:**

    - `measured`: exitance per unit power entering, 1/mm^2, on an absolute scale, with positive
      standard errors.
    - `start`: start of the search, within a factor of about ten of the result; its `eta` is kept.
    - `beam_variance`: variance of the laser beam per axis, mm^2.
    - `model`: computes the profile of a medium, which must be finite at the origin.
    - `count`: number of Gaussians.
    - `throw`: raise if the search has not converged; otherwise `result` reports it.

    **Returns:** a `MediumFit`.

    **Raises:** `ValueError` for deviations that are missing or not positive, and for unequal
    numbers of channels; an error with the message of `result` if `throw`.
    """
    channels = measured.values.shape[1]
    require(
        measured.deviation is not None and start.channels == channels,
        "fit_medium needs measured.deviation, the standard errors of its samples, and a start of "
        f"{channels} channels; got {measured.deviation} and {start.channels} channels",
    )
    check_values("measured.deviation", measured.deviation, "positive", lambda x: x > 0)
    require(
        not model(start).singular,
        f"model is {model}, whose profile is infinite at the origin; give Dipole or BetterDipole",
    )
    fitted = _fit_compiled(
        measured,
        start,
        as_floats(beam_variance, measured.values.dtype),
        model,
        count,
    )
    failed = fitted.result != optx.RESULTS.successful
    return fitted.result.error_if(fitted, failed) if throw else fitted


@eqx.filter_jit
def _fit_compiled(measured, start, beam_variance, model, count) -> MediumFit:
    def fit_channel(values, deviation, sigma_a, sigma_s_prime, eta):
        def residuals(point, _):
            fitted = fit_gaussians(
                model(Medium(*jnp.exp(point), eta)),
                count,
                spread=VariancesPerChannel(),
                throw=False,
            )
            gaussians = jax.tree.map(lambda leaf: leaf[0], fitted.gaussians)
            return (gaussians.blurred(beam_variance)(measured.radii)[:, 0] - values) / deviation

        solver = optx.LevenbergMarquardt(
            rtol=_TOLERANCE, atol=_TOLERANCE, linear_solver=NormalEquations()
        )
        point = jnp.log(jnp.stack([sigma_a, sigma_s_prime]))
        end = optx.least_squares(residuals, solver, point, max_steps=_STEPS, throw=False)
        slopes, residual = jax.jacfwd(lambda point: (residuals(point, None),) * 2, has_aux=True)(
            end.value
        )
        return (
            jnp.exp(end.value),
            invert(slopes.T @ slopes),
            residual @ residual / max(len(values) - len(point), 1),
            end.result == optx.RESULTS.successful,
        )

    coefficients, covariance, chi_squared, converged = jax.vmap(fit_channel)(
        measured.values.T, measured.deviation.T, start.sigma_a, start.sigma_s_prime, start.eta
    )
    result = optx.RESULTS.where(
        jnp.all(converged), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    return MediumFit(Medium(*coefficients.T, start.eta), covariance, chi_squared, result)
