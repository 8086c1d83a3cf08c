"""Figure 4: the layers of a picture, one for each radius."""

import numpy as np
from matplotlib.figure import Figure

from splatjax.scene import Material

from ._subject import Subject, bright, picture_grid


def figure_4(subject: Subject, material: Material) -> Figure:
    r"""Draw the layers of a picture, the narrowest first: as they are, and as their weights color
    what they add.

    **Arguments:**

    - `subject`: the body.
    - `material`: of as many layers as it has Gaussians.

    **Returns:** a matplotlib `Figure`; the lower pictures add up to the diffuse part of the frame,
    at one exposure.

    **Source:** Kim et al. 2010, Figure 4.
    """
    frame = subject.drawn(material)[0]
    variances = np.asarray(material.gaussians.variances, np.float64)
    order = np.argsort(variances)
    layers, weights = np.asarray(frame.layers)[order], np.asarray(frame.weights)[order]
    handed_over = np.asarray(frame.handed_over)[order] > 0.5
    gray, color = bright(list(layers)), bright([np.asarray(frame.diffuse)])
    titles = [
        f"{width:.2g} mm" + (" (the surface's light)" if gone else "")
        for width, gone in zip(np.sqrt(variances[order]), handed_over, strict=True)
    ]
    added = [
        color * weight[None, None] * layer for weight, layer in zip(weights, layers, strict=True)
    ]
    return picture_grid(
        [[gray * layer for layer in layers], added], titles, ["layer", "what it adds"], inches=2.3
    )
