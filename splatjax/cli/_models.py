"""The models of `docs/which_profile.md` by name: what `splatjax fit` makes of coefficients."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp

import splatjax as sj
from splatjax.scattering import AbstractRadialRule

from ._report import stage

Model: TypeAlias = Literal["dipole", "better-dipole", "photon-beam", "monte-carlo"]
_CUT = 0.2  # mean free paths


@dataclass(frozen=True)
class Reference:
    """A profile to be fitted, and the radii at which its fit counts.

    **Attributes:**

    - `single`: light that scatters once, where it is kept apart from the profile.
    - `description`: of a profile that coefficients alone do not give back.
    """

    profile: sj.gaussians.AbstractProfile
    rule: AbstractRadialRule = sj.scattering.L2_QUADRATURE
    single: sj.SingleScattering | None = None
    description: str | None = None


def reference(
    coefficients: sj.Dipole | sj.LayeredMultipole,
    model: Model,
    cut: float | None,
    photons: int,
    single_scattering: bool,
) -> Reference:
    """Return the profile of a medium or of layers by a model.

    **Arguments:**

    - `cut`: mean free paths from which on a profile counts that is infinite at the origin.
    - `single_scattering`: whether light that scatters once is taken out of the profile.

    **Raises:** `ValueError` for options that do not go with the model or with layers.
    """
    option = f"--model {model}{' with --single-scattering' if single_scattering else ''}"
    if cut is not None and option != "--model photon-beam" and model != "monte-carlo":
        raise ValueError(f"--cut has no effect on {option}, which is finite at the origin")
    if single_scattering and model not in ("photon-beam", "monte-carlo"):
        raise ValueError(f"{option} is not possible; take photon-beam or monte-carlo")
    beyond = sj.scattering.L2_QUADRATURE.beyond(_CUT if cut is None else cut)
    if isinstance(coefficients, sj.LayeredMultipole):
        if model == "dipole":
            return Reference(coefficients)
        if model == "monte-carlo" and not single_scattering:
            return _walked(coefficients.layers, photons, beyond)
        raise ValueError(
            f"{option} is for a half space, and this material has layers; take --model dipole or "
            "monte-carlo without --single-scattering"
        )
    medium = coefficients.medium
    single = sj.SingleScattering(medium)
    if model == "monte-carlo":
        half_space = sj.Layer(medium, jnp.asarray(jnp.inf))
        return _walked((half_space,), photons, beyond, single if single_scattering else None)
    if single_scattering:
        profile = sj.scattering.PhotonBeam(medium).multiply_scattered()
        return Reference(
            profile, single=single, description="photon beam, without single scattering"
        )
    if model == "photon-beam":
        return Reference(sj.scattering.PhotonBeam(medium), beyond)
    return Reference(coefficients if model == "dipole" else sj.scattering.BetterDipole(medium))


def _walked(
    layers: tuple[sj.Layer | sj.Film, ...],
    photons: int,
    rule: AbstractRadialRule,
    single: sj.SingleScattering | None = None,
) -> Reference:
    """Walk in single precision, which suffices for photons; the profile is fitted in double."""
    layers_32 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), list(layers))
    with stage("walking photons", photons) as report:
        walk = sj.transport.monte_carlo(
            layers_32, photons, jax.random.key(0), progress=lambda done, _: report(done)
        )
    profile = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), walk.profile())
    description = f"Monte Carlo, {photons} photons"
    if single is None:
        return Reference(profile, rule, None, description)
    description += ", without single scattering"
    return Reference(profile.without(single), rule, single, description)
