"""What more Gaussians gain."""

import numpy as np
from matplotlib.figure import Figure

from splatjax.fitting import ErrorByCount

from ._fit import colors_of


def plot_error_by_count(by_count: ErrorByCount, *, title: str | None = None) -> Figure:
    r"""Draw the error (Eq. 4) of each channel over the number of Gaussians, on a logarithmic axis.

    **Arguments:**

    - `by_count`: of `error_by_count`.
    - `title`: of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    error = np.asarray(by_count.error)
    counts = np.arange(1, len(error) + 1)
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    for channel, color in enumerate(colors_of(error.shape[1])):
        axes.semilogy(counts, error[:, channel], "o-", color=color, markersize=4, linewidth=1.2)
    axes.set(xlabel="number of Gaussians", ylabel="E (Eq. 4)", xticks=counts)
    axes.grid(axis="y", color="0.9")
    if title is not None:
        figure.suptitle(title)
    return figure
