"""What was observed, what the recovered material makes of it, and what is left."""

import numpy as np
from matplotlib.figure import Figure

from splatjax.inverse import Recovery
from splatjax.io import linear_to_srgb


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
