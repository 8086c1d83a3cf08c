"""Pictures as a display shows them: side by side, and observed ones beside recovered ones."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from splatjax.inverse import Recovery
from splatjax.io import linear_to_srgb

# Quantile of a row's values that is shown as white.
_BRIGHTEST = 0.995


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


def plot_recovery(recovery: Recovery, *, title: str | None = None) -> Figure:
    r"""Draw for each picture what was observed, the recovered material in its place, and the
    difference.

    Pixels that do not count are gray. The difference is the mean of the channels, over the
    picture's root mean square.

    **Arguments:**

    - `recovery`: of `recover`.
    - `title`: of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    rows = len(recovery.pictures)
    figure = Figure(figsize=(9.5, 3.1 * rows), layout="constrained")
    axes = figure.subplots(rows, 3, squeeze=False)
    for number, (line, made, left) in enumerate(
        zip(axes, recovery.pictures, recovery.residuals, strict=True), 1
    ):
        seen = made - left
        bright = float(np.nanquantile(seen, 0.99)) or 1.0
        for ax, picture, name in zip(
            line, (seen, made), (f"picture {number}", "recovered"), strict=False
        ):
            ax.imshow(_shown(picture, bright))
            ax.set_title(name)
        share = 100 * np.mean(left, axis=-1) / np.sqrt(np.nanmean(seen**2))
        reach = float(np.nanquantile(np.abs(share), 0.99)) or 1.0
        image = line[2].imshow(share, cmap="RdBu_r", vmin=-reach, vmax=reach)
        line[2].set_facecolor("0.8")
        line[2].set_title("recovered less seen")
        figure.colorbar(image, ax=line[2], label="% of the picture", shrink=0.8)
        for ax in line:
            ax.set(xticks=[], yticks=[])
    if title is not None:
        figure.suptitle(title)
    return figure


def _shown(picture: np.ndarray, bright: float) -> np.ndarray:
    """Encode for the screen; three channels of any number."""
    unknown = ~np.all(np.isfinite(picture), axis=-1, keepdims=True)
    gray = np.broadcast_to(np.mean(picture, axis=-1, keepdims=True), (*picture.shape[:2], 3))
    colors = picture if picture.shape[-1] == 3 else gray
    encoded = linear_to_srgb(np.where(unknown, 0.0, colors) / bright)
    return np.where(unknown, 0.8, encoded)
