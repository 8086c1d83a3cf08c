"""Figure 6: bodies in several materials."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from splatjax.scene import Material

from ._subject import Subject, bright, picture_grid


def figure_6(subjects: Sequence[Subject], materials: Mapping[str, Material]) -> Figure:
    r"""Draw every body in every material.

    The first material is drawn with the map of a body's color; the others show their own color.

    **Arguments:**

    - `subjects`: one or more, with pictures of one size.
    - `materials`: by name.

    **Returns:** a matplotlib `Figure`; every picture has its own exposure.

    **Source:** Kim et al. 2010, Figure 6.
    """
    rows = []
    for subject in subjects:
        line = []
        for number, material in enumerate(materials.values()):
            body = subject if number == 0 else subject.without_albedo()
            picture = np.asarray(body.drawn(material)[0].beauty)
            line.append(bright([picture]) * picture)
        rows.append(line)
    return picture_grid(rows, list(materials), [subject.name for subject in subjects], inches=3.0)
