"""Rendered pictures side by side, as a display shows them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from splatjax.io import linear_to_srgb

_BRIGHTEST = 0.995
"""Quantile of a row's values that is shown as white."""


def plot_pictures(
    rows: Sequence[Sequence[ArrayLike]],
    titles: Sequence[str],
    names: Sequence[str] | None = None,
    *,
    white: float | None = None,
    inches: float = 2.6,
) -> Figure:
    r"""Draw a grid of pictures of linear light over black, encoded as sRGB.

    **Arguments:**

    - `rows`: of pictures `[height, width, 3]`, premultiplied by their coverage, as those of a
      `Frame` are.
    - `titles`: of the columns.
    - `names`: of the rows.
    - `white`: value that is shown as white. By default each row has its own exposure: of its values
      above zero 0.5% are brighter than white.
    - `inches`: height of a picture.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    height, width = np.shape(rows[0][0])[:2]
    size = (inches * width / height * len(titles), inches * len(rows) + 0.2)
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    grid = figure.subplots(len(rows), len(titles), squeeze=False)
    for number, (line, pictures) in enumerate(zip(grid, rows, strict=True)):
        values = np.stack([np.asarray(picture, np.float64) for picture in pictures])
        brightest = np.quantile(values[values > 0], _BRIGHTEST) if white is None else white
        for axes, picture in zip(line, linear_to_srgb(values / brightest), strict=True):
            axes.imshow(picture, interpolation="nearest")
            axes.set(xticks=[], yticks=[], frame_on=False)
        if names is not None:
            line[0].set_ylabel(names[number], fontsize="small")
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize="small")
    return figure
