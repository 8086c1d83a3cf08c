"""The compiled programs that run while a slider moves."""

from dataclasses import replace
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import fitting as _fitting
from splatjax.gaussians import SumOfGaussians
from splatjax.render import DiffusionBasis
from splatjax.scattering import AngularLaw, Medium, Skin

Optics: TypeAlias = Medium | Skin
_WEIGHTS = _fitting.NonNegativeWeights(_fitting.FixedTotalReflectance())


@eqx.filter_jit
def blend(
    basis: DiffusionBasis, gaussians: SumOfGaussians, shares: Float[Array, "2"]
) -> Float[Array, "height width channels"]:
    """Compute a picture from given shares of the diffuse and the specular light."""
    return shares[0] * (basis.beauty(gaussians) - basis.specular) + shares[1] * basis.specular


@eqx.filter_jit
def light_of_gaussians(
    basis: DiffusionBasis, gaussians: SumOfGaussians, place: tuple[int, int]
) -> Float[Array, "gaussians channels"]:
    """Compute the contribution of each Gaussian to the radiance of a pixel (row, column)."""
    layers, _ = basis.light.weigh(gaussians, jnp.zeros_like(gaussians.weights[0]))
    radiance = gaussians.weights[:, :, None] * layers * basis.pixel_radiance_per_exitance[None]
    at_pixel = basis.pixels == place[0] * basis.specular.shape[1] + place[1]
    return jnp.sum(jnp.where(at_pixel, radiance, 0.0), axis=2)


@eqx.filter_jit
def changes_with_coefficients(
    model: _fitting.AbstractModel,
    optics: Optics,
    names: tuple[str, ...],
    variances: Float[Array, " gaussians"],
    has_color: bool,
    basis: DiffusionBasis,
    place: tuple[int, int],
) -> list[Float[Array, " channels"]]:
    """Differentiate the radiance of a pixel with respect to the logarithms of fields. Each channel
    depends only on its own coefficients.
    """

    def radiance(name: str, value: Array) -> Float[Array, " channels"]:
        gaussians = weights_of(model, replace(optics, **{name: value}), variances)
        gaussians = gaussians if has_color else gaussians.white()
        return jnp.sum(light_of_gaussians(basis, gaussians, place), axis=0)

    values = {name: getattr(optics, name) for name in names}
    return [jax.jvp(partial(radiance, n), (value,), (value,))[1] for n, value in values.items()]


@eqx.filter_jit
def weights_of(
    model: _fitting.AbstractModel, optics: Optics, variances: Float[Array, " gaussians"]
) -> SumOfGaussians:
    """Fit the weights to coefficients, with fixed variances."""
    return _fitting.fit_weights(model.profile(optics), variances, weights=_WEIGHTS, rule=model.rule)


@eqx.filter_jit
def variances_and_angles(
    model: _fitting.AbstractModel, optics: Optics, variances: Float[Array, " gaussians"]
) -> tuple[Float[Array, " gaussians"], AngularLaw | None]:
    """Refine the variances, starting from the given ones, and compute the angular law."""
    profile, start = model.profile(optics), _fitting.GivenVariances(variances)
    fitted = _fitting.fit_gaussians(
        profile, len(variances), weights=_WEIGHTS, start=start, rule=model.rule, throw=False
    )
    held = _fitting.fit_weights(profile, variances, weights=_WEIGHTS, rule=model.rule)
    error = _fitting.relative_error(profile, held, model.rule)
    is_better = jnp.max(fitted.error) < jnp.max(error)
    return jnp.where(is_better, fitted.gaussians.variances, variances), model.angles(optics)


@eqx.filter_jit
def profile_curves(
    model: _fitting.AbstractModel,
    optics: Optics | None,
    gaussians: SumOfGaussians,
    radii: Float[Array, " radii"],
) -> list[Float[Array, " radii"]]:
    """Compute the sum of Gaussians and, if there are coefficients, the profile, both times r."""
    profiles = [gaussians] if optics is None else [model.profile(optics), gaussians]
    return [radii * row for profile in profiles for row in profile(radii).T]
