"""What `splatjax fit` makes of coefficients: the models of `docs/which_profile.md` by name."""

import sys
from dataclasses import dataclass
from enum import Enum

import jax
import jax.numpy as jnp
from rich.progress import Progress

import splatjax as sj
from splatjax.scattering import AbstractRadialRule

_CUT = 0.2  # mean free paths


class Model(Enum):
    """Names of the models."""

    DIPOLE = "dipole"
    BETTER_DIPOLE = "better-dipole"
    PHOTON_BEAM = "photon-beam"
    MONTE_CARLO = "monte-carlo"


@dataclass(frozen=True)
class Reference:
    """A profile to be fitted, and where its fit begins; and what light that scatters once does
    beside it.
    """

    profile: sj.AbstractProfile
    rule: AbstractRadialRule
    single: sj.SingleScattering | None = None


def reference(
    coefficients: sj.Dipole | sj.LayeredMultipole,
    model: Model,
    cut: float | None,
    photons: int,
    apart: bool,
) -> Reference:
    """Give what a model makes of a medium or of layers; `cut` is in mean free paths, 0.2 if it is
    not given.

    With `apart` light that scatters once is taken out of the profile.

    **Raises:** `ValueError` for layers and a model that knows a half space alone, for a cut of what
    is finite, and for single scattering taken out of layers or of a dipole.
    """
    layered = isinstance(coefficients, sj.LayeredMultipole)
    if cut is None:
        cut = _CUT
    elif not (model is Model.MONTE_CARLO or (model is Model.PHOTON_BEAM and not apart)):
        what = f"--model {model.value}{' with --single-scattering' if apart else ''}"
        raise ValueError(
            f"--cut has no effect on {what}, which is finite at the origin; leave it out"
        )
    if apart:
        return _apart(coefficients, model, cut, photons)
    if model is Model.DIPOLE:
        return Reference(coefficients, sj.L2_QUADRATURE)
    if model is Model.MONTE_CARLO:
        layers = (
            coefficients.layers
            if layered
            else (sj.Layer(coefficients.medium, jnp.asarray(jnp.inf)),)
        )
        return Reference(_walked(layers, photons), sj.L2_QUADRATURE.beyond(cut))
    if layered:
        raise ValueError(
            f"--model {model.value} knows a half space, and this material has layers; take dipole "
            "or monte-carlo"
        )
    if model is Model.BETTER_DIPOLE:
        return Reference(sj.BetterDipole(coefficients.medium), sj.L2_QUADRATURE)
    return Reference(sj.PhotonBeam(coefficients.medium), sj.L2_QUADRATURE.beyond(cut))


def _apart(
    coefficients: sj.Dipole | sj.LayeredMultipole, model: Model, cut: float, photons: int
) -> Reference:
    if isinstance(coefficients, sj.LayeredMultipole):
        raise ValueError(
            "--single-scattering knows a half space, and this material has layers; leave it out"
        )
    single = sj.SingleScattering(coefficients.medium)
    match model:
        case Model.PHOTON_BEAM:
            return Reference(
                sj.PhotonBeam(coefficients.medium).multiply_scattered(), sj.L2_QUADRATURE, single
            )
        case Model.MONTE_CARLO:
            found = reference(coefficients, model, cut, photons, apart=False)
            assert isinstance(found.profile, sj.Tabulated)
            return Reference(found.profile.without(single), found.rule, single)
    raise ValueError(
        f"--single-scattering is no part of --model {model.value}; take photon-beam or monte-carlo"
    )


def _walked(layers: tuple[sj.Layer | sj.Film, ...], photons: int) -> sj.Tabulated:
    """Walk in single precision, which is what photons need; the profile is then fitted in
    double.
    """
    single = jax.tree.map(lambda each: each.astype(jnp.float32), list(layers))
    with Progress(console=None, disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task("walking photons", total=1.0)
        found = sj.monte_carlo(
            single,
            photons,
            jax.random.key(0),
            progress=lambda done, photons: progress.update(task, completed=done / photons),
        )
    return jax.tree.map(lambda each: each.astype(jnp.float64), found.profile())
