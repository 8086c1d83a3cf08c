"""The report of `splatjax fit`."""

import jax.numpy as jnp
import numpy as np

import splatjax as sj

from ._models import Reference
from ._terminal import print_table

_DISTANCES = 7


def print_fit(fitted: sj.fitting.FitResult, target: Reference) -> None:
    """Print the Gaussians of a fit, their errors, and the relative error by distance."""
    print_table(
        [
            *fitted.table(),
            ("at r, mm", "fit over profile, less 1"),
            *_errors_by_distance(target.profile, fitted.gaussians, target.rule),
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
