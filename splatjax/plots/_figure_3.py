"""Figure 3: a Gaussian on the radius of a splat, and a profile composed of layers of increasing
radius.
"""

import jax.numpy as jnp
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from splatjax.gaussians import SumOfGaussians, gaussian

from ._fit import colors_of, single_gaussians

_POINTS = 400
_DECADES = 4.0


def figure_3(gaussians: SumOfGaussians, *, title: str | None = None) -> Figure:
    r"""Draw the layers of a profile as splats of increasing radius, and how they add up.

    Above, each layer's Gaussian as it lies on a splat, all to one scale and as bright as it is,
    over four decades. Below, the sum for each channel and the single layers under it.

    **Arguments:**

    - `gaussians`: the profile, mm.
    - `title`: of the figure.

    **Returns:** a matplotlib `Figure`.

    **Source:** Kim et al. 2010, Figure 3.
    """
    variances = np.asarray(gaussians.variances, np.float64)
    order = np.argsort(variances)
    widths, weights = np.sqrt(variances[order]), np.asarray(gaussians.weights, np.float64)[order]
    colors = colors_of(weights.shape[1])
    reach = 2.5 * widths[-1]
    peak = float(np.max(weights.mean(axis=1) / (2 * np.pi * widths**2)))

    figure = Figure(figsize=(1.7 * len(widths) + 0.4, 6.2), dpi=150, layout="constrained")
    grid = figure.add_gridspec(2, len(widths), height_ratios=(1, 1.9))
    line = np.linspace(-reach, reach, 181)
    squared = jnp.asarray(line[:, None] ** 2 + line[None] ** 2)
    for column, (width, weight) in enumerate(zip(widths, weights, strict=True)):
        axes = figure.add_subplot(grid[0, column])
        spread = weight.mean() * np.asarray(gaussian(jnp.full_like(squared, width**2), squared))
        shades = LogNorm(peak * 10**-_DECADES, peak)
        axes.imshow(
            np.maximum(spread, 1e-30),
            cmap="magma",
            norm=shades,
            extent=(-reach, reach, -reach, reach),
        )
        axes.add_patch(
            Circle((0, 0), width, fill=False, color="white", linewidth=0.6, linestyle=":")
        )
        axes.set_title(f"{width:.2g} mm", fontsize="small", pad=3)
        axes.set_xlabel("  ".join(f"{each:.3f}" for each in weight), fontsize=6.5)
        axes.set(xticks=[], yticks=[])

    axes = figure.add_subplot(grid[1, :])
    r = np.linspace(0, reach, _POINTS)
    radii = jnp.asarray(r)
    total = np.asarray(gaussians(radii), np.float64)
    single = np.asarray(single_gaussians(gaussians, radii), np.float64)[:, order]
    below = np.zeros_like(r)
    for column in range(len(widths)):
        shade = str(0.45 + 0.5 * column / len(widths))
        axes.fill_between(
            r,
            below,
            below + single[:, column],
            color=shade,
            linewidth=0,
            label=f"{widths[column]:.2g} mm",
        )
        below = below + single[:, column]
    for channel, color in enumerate(colors):
        axes.plot(r, total[:, channel], color=color, linewidth=1.8)
    axes.set(
        xlabel="r (mm)",
        ylabel="R(r) (1/mm²)",
        yscale="log",
        xlim=(0, reach),
        ylim=(0.3 * below[-1], 1.5 * total.max()),
    )
    axes.legend(
        title="layers, stacked (mean weight)",
        fontsize="small",
        title_fontsize="small",
        frameon=False,
    )
    if title is not None:
        figure.suptitle(title)
    return figure
