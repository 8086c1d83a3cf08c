"""Fits of coefficients for `splatjax fit`: models by name (`docs/which_profile.md`), fits of many
media for `--all`, and the report of a fit.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import splatjax as sj
from splatjax._format import channel_names, counted

from ._terminal import note, print_table, stage

Model: TypeAlias = Literal["dipole", "better-dipole", "photon-beam", "monte-carlo"]
Coefficients: TypeAlias = (
    sj.Dipole | sj.LayeredMultipole | sj.scattering.Skin | sj.scattering.Burley
)
# Weights of the fit to a medium, which conserve the energy of the picture.
MEDIUM_WEIGHTS = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())

_LARGE = 0.05  # error of a fit that is worth a note
_APART = 3.0  # ratio of the widths of channels, too large to share six variances


def model_by_name(model: Model | None, g: float) -> sj.fitting.AbstractModel:
    """Return the model of a half space that an option names, by default light transport.

    **Raises:** `ValueError` for a mean cosine that the model does not support.
    """
    if g and model in ("dipole", "better-dipole"):
        raise ValueError(f"--model {model} with --g {g} is not possible; use photon-beam")
    if model == "better-dipole":
        return sj.fitting.DiffusionModel(sj.scattering.BetterDipole)
    return sj.fitting.DiffusionModel() if model == "dipole" else sj.fitting.TransportModel(g)


@dataclass(frozen=True)
class Reference:
    """A profile to fit, and the settings of the fit.

    **Attributes:**

    - `single`: light that is scattered once, if it is separate from the profile.
    - `description`: describes a profile that coefficients alone do not define.
    - `angles`: dependence of the light on the angles of entry and exit.
    - `weights`: the weights that the fit allows.
    """

    profile: sj.gaussians.AbstractProfile
    rule: sj.scattering.AbstractRadialRule = sj.scattering.L2_QUADRATURE
    single: sj.SingleScattering | None = None
    description: str | None = None
    angles: sj.scattering.AngularLaw | None = None
    weights: sj.fitting.AbstractWeights = MEDIUM_WEIGHTS


def reference(
    coefficients: Coefficients,
    model: Model | None,
    photons: int,
    g: float,
    single_scattering: bool,
    is_rgb: bool = True,
) -> Reference:
    """Compute the profile of a medium or of layers by a model.

    **Arguments:**

    - `model`: `None` is the photon beam with the total of light transport, or for layers the
      multipole.
    - `g`: mean cosine of the phase function.
    - `single_scattering`: whether light that is scattered once is separated from the profile.
    - `is_rgb`: whether the wavelengths of a skin are converted to linear sRGB, under daylight.

    **Raises:** `ValueError` for options that the model or a material with layers does not support.
    """
    is_burley = isinstance(coefficients, sj.scattering.Burley)
    if is_burley or isinstance(coefficients, sj.scattering.Skin):
        if model or g or single_scattering:
            raise ValueError(
                "a [skin] is fitted by light transport in its layers with the g of its table, and "
                "a [burley] directly; leave --model, --g and --single-scattering out"
            )
        if is_burley:
            return Reference(coefficients, sj.fitting.TransportModel.rule)
        nodes = coefficients.wavelengths
        matrix = sj.io.spectrum_to_rgb(nodes) if is_rgb else np.eye(len(nodes))
        return _by_model(sj.fitting.SkinModel(matrix), coefficients)
    is_layered = isinstance(coefficients, sj.LayeredMultipole)
    model = model or ("dipole" if is_layered else "photon-beam")
    option = f"--model {model}{' with --single-scattering' if single_scattering else ''}"
    if (single_scattering or g) and model not in ("photon-beam", "monte-carlo"):
        option = option if single_scattering else f"{option} with --g {g}"
        raise ValueError(f"{option} is not possible; use photon-beam or monte-carlo")
    if is_layered and (single_scattering or model not in ("dipole", "monte-carlo")):
        raise ValueError(
            f"{option} is for a half space, but this material has layers; use --model dipole or "
            "monte-carlo without --single-scattering"
        )
    if model == "monte-carlo":
        target = _walked(coefficients, photons, g)
    elif is_layered:
        target = Reference(coefficients)
    else:
        target = _by_model(model_by_name(model, g), coefficients.medium)
    if is_layered or not single_scattering:
        return target
    return _without_single(target, coefficients.medium, g)


def _by_model(model: sj.fitting.AbstractModel, optics: sj.Medium | sj.scattering.Skin) -> Reference:
    return Reference(
        model.profile(optics),
        model.rule,
        description=model.description,
        angles=model.angles(optics),
    )


def _without_single(target: Reference, medium: sj.Medium, g: float) -> Reference:
    """Separate the light that is scattered once from a profile, and compute the angles of the
    rest.
    """
    model = sj.fitting.TransportModel(g)
    whole: Any = target.profile
    beam = whole if isinstance(whole, sj.scattering.PhotonBeam) else model.profile(medium)
    single, half_space = beam.single_scattered(), model.half_space(medium)
    scattered_once = single.directional_albedo(jnp.asarray(half_space.cosines()))
    return replace(
        target,
        profile=beam.multiply_scattered() if beam is whole else whole.without(single),
        single=single,
        description=f"{target.description}, without single scattering",
        angles=half_space.angular_law(scattered_once),
    )


def _walked(coefficients: sj.Dipole | sj.LayeredMultipole, photons: int, g: float) -> Reference:
    """Compute the profile by Monte Carlo in single precision, which suffices."""
    is_layered = isinstance(coefficients, sj.LayeredMultipole)
    layers = coefficients.layers if is_layered else [sj.Layer(coefficients.medium, jnp.inf)]
    layers_32 = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), list(layers))
    with stage("walking photons", photons) as report:
        walk = sj.transport.monte_carlo(
            layers_32,
            photons,
            jax.random.key(0),
            g=g,
            progress=lambda done, _: report(done),
        )
    return Reference(
        jax.tree.map(lambda leaf: leaf.astype(jnp.float64), walk.profile()),
        sj.fitting.TransportModel.rule,
        description=f"Monte Carlo, {photons} photons",
        angles=None
        if is_layered
        else sj.scattering.HalfSpace(coefficients.medium, g).angular_law(),
    )


BATCH = 500  # media per call


@eqx.filter_jit
def _fit_each(
    coefficients: Float[Array, "media 3"],
    starts: sj.fitting.DipoleStarts,
    count: int,
    model: sj.fitting.AbstractModel,
):
    def fit(row):
        medium = sj.Medium(row[0:1], row[1:2], row[2:3])
        fitted = sj.fit_gaussians(
            model.profile(medium),
            count,
            start=sj.fitting.GivenVariances(starts(medium, count).variances[0]),
            weights=MEDIUM_WEIGHTS,
            rule=model.rule,
            throw=False,
        )
        return fitted, model.angles(medium), fitted.result == optx.RESULTS.successful

    return eqx.filter_vmap(fit)(coefficients)


def fit_batch(
    coefficients: np.ndarray, count: int, model: sj.fitting.AbstractModel
) -> dict[str, np.ndarray]:
    """Fit a batch of media, and return the columns of the table. A smaller batch is padded, so that
    one program serves all. Fits start from the variances for dipoles, which are near the optima of
    the other models.
    """
    length = len(coefficients)
    padded = np.pad(coefficients, ((0, BATCH - length), (0, 0)), mode="edge")
    fitted, angles, converged = _fit_each(jnp.asarray(padded), sj.io.dipole_starts(), count, model)
    powers = [] if angles is None else angles.coefficients[..., 0].T
    columns = {
        **dict(zip(("sigma_a", "sigma_s_prime", "eta"), padded.T, strict=True)),
        **{f"variance_{i + 1}": fitted.gaussians.variances[:, i] for i in range(count)},
        **{f"weight_{i + 1}": fitted.gaussians.weights[:, i, 0] for i in range(count)},
        **{f"angles_{power}": column for power, column in enumerate(powers)},
        "error": fitted.error[:, 0],
        "energy_error": fitted.energy_error[:, 0],
        "converged": converged.astype(float),
    }
    return {name: np.asarray(column)[:length] for name, column in columns.items()}


_DISTANCES = 7


def print_fit(fitted: sj.fitting.FitResult, target: Reference) -> None:
    """Print the Gaussians of a fit, their errors, and the relative error at radii of the fit where
    the light of any channel, per logarithmic radius, is above a hundredth of its peak.
    """
    profile, rule = target.profile, target.rule
    nodes, weights = (np.asarray(values) for values in rule.radii(profile))
    first, measured = nodes[weights > 0].min(), profile.known_radii()
    least = max(first, 0.1 * float(profile.length_scale().min()))
    radii = (
        jnp.geomspace(least, nodes.max(), 400) if measured is None else measured[0][measured[0] > 0]
    )
    light = np.asarray(radii)[:, None] ** 2 * np.asarray(profile(radii))
    counts = light > 0.01 * light.max(axis=0)
    within = np.flatnonzero(counts.any(axis=1))
    places = np.unique(np.linspace(within[0], within[-1], _DISTANCES).round().astype(int))
    errors = np.asarray(fitted.gaussians(radii) / profile(radii) - 1)
    begin = "" if rule.reaches_origin else f", fitted from {first:.2g} mm"
    rows = [*fitted.table(), ("at r, mm", f"fit over profile, less 1{begin}")]
    for i in places:
        cells = zip(errors[i], counts[i], strict=True)
        formatted = [f"{error:+.1%}" if is_counted else "-" for error, is_counted in cells]
        rows.append((f"{float(radii[i]):.3g}", "  ".join(formatted)))
    print_table(rows)


def note_error(name: str, target: Reference, fitted: sj.fitting.FitResult) -> None:
    """Print a note about a large error, and its reason: a profile that is negative, because its
    color is outside sRGB, or different widths of channels.
    """
    error, profile = float(fitted.error.max()), target.profile
    if error <= _LARGE:
        return
    radii, _ = target.rule.radii(profile)
    values = np.asarray(sj.scattering.at_own_radii(profile, radii))
    negative = np.any(values < 0, axis=0)
    if np.any(negative):
        colors = " and ".join(np.asarray(channel_names(len(negative)))[negative])
        note(
            f"{name}: its {colors} are negative from {radii[values < 0].min():.2g} mm on, outside "
            f"sRGB, where no Gaussians can follow them (error {error:.2g}); their totals are right"
        )
        return
    scales, count = profile.length_scale(), len(fitted.gaussians.variances)
    ratio = float(scales.max() / scales.min())
    reason = (
        f"the widths of its channels differ by a factor of {ratio:.2g}, too far apart to share "
        f"{count} variances"
        if ratio > _APART
        else f"{counted(count, 'Gaussian')} cannot follow its profile"
    )
    note(f"{name}: {reason} (error {error:.2g}); give a larger --count, or --error {_LARGE}")
