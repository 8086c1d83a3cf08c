"""The report of `splatjax fit`."""

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax._format import channel_names

from ._models import Reference
from ._terminal import print_table

_DISTANCES = 7


def print_fit(fitted: sj.fitting.FitResult, target: Reference) -> None:
    """Print the Gaussians of a fit, their errors, and the relative error by distance."""
    gaussians = fitted.gaussians
    names = ", ".join(channel_names(gaussians.weights.shape[1]))
    pairs = zip(gaussians.variances, gaussians.weights, strict=True)
    print_table(
        [
            ("variance, mm^2", f"weights ({names})"),
            *((f"{float(variance):.6g}", format_numbers(row, ".5f")) for variance, row in pairs),
            ("sum", format_numbers(gaussians.total_reflectance(), ".5f")),
            ("error (Eq. 4)", format_numbers(fitted.error, ".2e")),
            ("energy error", format_numbers(fitted.energy_error, ".2e")),
            ("at r, mm", "fit over profile, less 1"),
            *_errors_by_distance(target.profile, gaussians, target.rule),
        ]
    )


def _errors_by_distance(
    profile: sj.gaussians.AbstractProfile,
    gaussians: sj.SumOfGaussians,
    rule: sj.scattering.AbstractRadialRule,
) -> list[tuple[str, str]]:
    """Return rows of relative errors, from where a fit counts to where all channels have a
    hundredth of the peak of their light by logarithmic radius.
    """
    nodes, weights = (np.asarray(each) for each in rule.radii(profile))
    known = profile.known_radii()
    least = max(nodes[weights > 0].min(), 0.1 * float(profile.length_scale().min()))
    dense = jnp.geomspace(least, nodes.max(), 400) if known is None else known[0][known[0] > 0]
    light = np.asarray(dense)[:, None] ** 2 * np.asarray(profile(dense))
    counts = light > 0.01 * light.max(axis=0)
    within = np.flatnonzero(counts.any(axis=1))
    places = np.unique(np.linspace(within[0], within[-1], _DISTANCES).round().astype(int))
    errors = np.asarray(gaussians(dense) / profile(dense) - 1)
    return [
        (
            f"{float(dense[i]):.3g}",
            "  ".join(
                f"{error:+.1%}" if counted else "-"
                for error, counted in zip(errors[i], counts[i], strict=True)
            ),
        )
        for i in places
    ]


def format_numbers(values: jax.Array, form: str) -> str:
    """Format numbers in one line."""
    return "  ".join(f"{float(value):{form}}" for value in values)
