"""Figure 7: elliptical points, surface splatting, and surface splatting with scattering."""

import numpy as np
from matplotlib.figure import Figure

from splatjax.baselines import (
    deferred_splatting,
    elliptical_points,
    ewa_splatting,
    normal_slopes,
    phong_splatting,
)
from splatjax.scene import Material

from ._subject import Subject, bright, picture_grid

_ZOOM = 5.0
_PLACE = 0.48, 0.34  # of the outline: beside the nose


def figure_7(
    subject: Subject,
    material: Material,
    *,
    zoom: float = _ZOOM,
    place: tuple[float, float] = _PLACE,
) -> Figure:
    r"""Draw a body by each point-based method, all under one light; below, a close-up of each.

    From left to right light appears smoother: elliptical points are flat, splats that are blended
    are smooth, scattering is soft.

    **Arguments:**

    - `subject`: the body.
    - `material`: with its scattering, which only the last picture has.
    - `zoom`: of the close-up.
    - `place`: of the close-up: share of the height and of the width of the body's outline.

    **Returns:** a matplotlib `Figure`, at one exposure.

    **Source:** Kim et al. 2010, Figure 7, which has the first, the fourth and the last.
    """
    near, plain = subject.close_up(*place, zoom), material.opaque()
    columns = {
        "elliptical points": (plain, elliptical_points()),
        "EWA splatting": (plain, ewa_splatting()),
        "Phong splatting": (plain, phong_splatting(normal_slopes(subject.splats))),
        "deferred splatting": (plain, deferred_splatting()),
        "with scattering": (material, None),
    }
    frames = [subject.drawn(*each, near) for each in columns.values()]
    factor = bright([np.asarray(whole.beauty) for whole, _ in frames])
    rows = [
        [factor * np.asarray(frame.beauty) for frame in line] for line in zip(*frames, strict=True)
    ]
    return picture_grid(rows, list(columns), inches=2.8)
