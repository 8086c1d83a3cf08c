"""Figure 1: splats, point-based rendering without scattering, and with it."""

from dataclasses import replace

import jax
import numpy as np
from matplotlib.figure import Figure

from splatjax.baselines import deferred_splatting, elliptical_points
from splatjax.scene import Material, Splats

from ._subject import Subject, bright, picture_grid

_DISCS = 6000
_RADIUS = 0.5  # of the discs that are shown, in roots of the area each stands for


def figure_1(subject: Subject, material: Material, *, discs: int = _DISCS) -> Figure:
    r"""Draw a set of surface splats; the surface they make, with light that leaves where it enters;
    and with scattering.

    **Arguments:**

    - `subject`: the body.
    - `material`: with its scattering.
    - `discs`: about how many splats are shown on the left, with gaps between them.

    **Returns:** a matplotlib `Figure`.

    **Source:** Kim et al. 2010, Figure 1.
    """
    few = replace(subject, splats=spaced(subject.splats, discs))
    left = few.drawn(material.opaque(), elliptical_points())[0]
    middle = subject.drawn(material.opaque(), deferred_splatting())[0]
    right = subject.drawn(material)[0]
    factor = bright([np.asarray(frame.beauty) for frame in (middle, right)])
    return picture_grid(
        [[factor * np.asarray(frame.beauty) for frame in (left, middle, right)]],
        ["surface splats", "light leaves where it enters", "light scatters below the surface"],
        inches=3.6,
    )


def spaced(splats: Splats, count: int) -> Splats:
    """Give about so many of the splats, as discs with gaps between them."""
    step = max(splats.count // count, 1)
    kept = jax.tree.map(lambda rows: rows[::step], splats)
    return replace(kept, radii=_RADIUS * (step * kept.areas) ** 0.5, areas=step * kept.areas)
