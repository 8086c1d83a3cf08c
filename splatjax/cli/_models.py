"""The models of `docs/which_profile.md` by name: what `splatjax fit` makes of coefficients."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp

import splatjax as sj

from ._terminal import stage

Model: TypeAlias = Literal["dipole", "better-dipole", "photon-beam", "monte-carlo"]
# Weights of the fit to a medium: the picture keeps its energy.
MEDIUM_WEIGHTS = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
# Radii for profiles that are infinite at the origin: from so many mean free paths on.
_BEYOND = sj.scattering.L2_QUADRATURE.beyond(0.2)


@dataclass(frozen=True)
class Reference:
    """A profile to be fitted, and the radii at which its fit counts.

    **Attributes:**

    - `single`: light that scatters once, where it is kept apart from the profile.
    - `description`: of a profile that coefficients alone do not give back.
    - `weights`: those that the fit may choose from.
    """

    profile: sj.gaussians.AbstractProfile
    rule: sj.scattering.AbstractRadialRule = sj.scattering.L2_QUADRATURE
    single: sj.SingleScattering | None = None
    description: str | None = None
    weights: sj.fitting.AbstractWeights = MEDIUM_WEIGHTS


def reference(
    coefficients: sj.Dipole | sj.LayeredMultipole,
    model: Model,
    photons: int,
    single_scattering: bool,
) -> Reference:
    """Return the profile of a medium or of layers by a model.

    **Arguments:**

    - `single_scattering`: whether light that scatters once is taken out of the profile.

    **Raises:** `ValueError` for options that do not go with the model or with layers.
    """
    option = f"--model {model}{' with --single-scattering' if single_scattering else ''}"
    if single_scattering and model not in ("photon-beam", "monte-carlo"):
        raise ValueError(f"{option} is not possible; take photon-beam or monte-carlo")
    is_layered = isinstance(coefficients, sj.LayeredMultipole)
    if is_layered and (single_scattering or model not in ("dipole", "monte-carlo")):
        raise ValueError(
            f"{option} is for a half space, and this material has layers; take --model dipole or "
            "monte-carlo without --single-scattering"
        )
    if model == "monte-carlo":
        return _walked(coefficients, photons, single_scattering)
    if is_layered or model == "dipole":
        return Reference(coefficients)
    if model == "better-dipole":
        return Reference(sj.scattering.BetterDipole(coefficients.medium))
    beam = sj.scattering.PhotonBeam(coefficients.medium)
    if not single_scattering:
        return Reference(beam, _BEYOND)
    return Reference(
        beam.multiply_scattered(),
        single=sj.SingleScattering(coefficients.medium),
        description="photon beam, without single scattering",
    )


def _walked(
    coefficients: sj.Dipole | sj.LayeredMultipole,
    photons: int,
    single_scattering: bool,
) -> Reference:
    """Walk in single precision, which suffices for photons; the profile is fitted in double."""
    is_layered = isinstance(coefficients, sj.LayeredMultipole)
    layers = coefficients.layers if is_layered else [sj.Layer(coefficients.medium, jnp.inf)]
    layers_32 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), list(layers))
    with stage("walking photons", photons) as report:
        walk = sj.transport.monte_carlo(
            layers_32, photons, jax.random.key(0), progress=lambda done, _: report(done)
        )
    profile = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), walk.profile())
    description = f"Monte Carlo, {photons} photons"
    if is_layered or not single_scattering:
        return Reference(profile, _BEYOND, None, description)
    single = sj.SingleScattering(coefficients.medium)
    description += ", without single scattering"
    return Reference(profile.without(single), _BEYOND, single, description)
