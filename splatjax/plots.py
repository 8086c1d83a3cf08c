"""Figures of profiles, fits, errors and pictures, drawn with matplotlib."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import ArrayLike

from splatjax._format import CHANNEL_COLORS, channel_names
from splatjax.fitting import ErrorByCount, relative_error
from splatjax.gaussians import AbstractProfile, SumOfGaussians, gaussian
from splatjax.inverse import Recovery
from splatjax.io import linear_to_srgb
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

_POINTS = 400
# Fraction of its peak down to which a profile is drawn.
_TAIL = 1e-7
# Light per logarithmic radius, relative to its peak, above which errors are drawn.
_LEAST = 1e-2
# Largest number of measured radii that are marked individually.
_FEW = 60
# Relative error of the energy below which it counts as rounding.
_HELD = 1e-6
# Quantile of the values of a row that is shown as white.
_BRIGHTEST = 0.995


def plot_fit(
    profile: AbstractProfile,
    gaussians: SumOfGaussians,
    *,
    rule: AbstractRadialRule = L2_QUADRATURE,
    title: str | None = None,
) -> Figure:
    r"""Draw a profile and its fit on linear and logarithmic axes, and the relative error of the fit
    against the distance.

    Three channels are drawn in red, green and blue. Each Gaussian of the fit, with its mean weight
    over the channels, is drawn in gray. Radii of a measurement are marked. The legend shows the
    error (Eq. 4), and the energy of the fit relative to that of the profile, minus 1, or "held" if
    the two are equal up to rounding.

    **Arguments:**

    - `profile`: the reference, 1/mm^2.
    - `gaussians`: the fit, with the same number of channels.
    - `rule`: the rule of the fit. Radii below its first are shaded and do not count.
    - `title`: title of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    r = _radii(profile)
    reference, fitted = (np.asarray(model(r), np.float64) for model in (profile, gaussians))
    error = np.asarray(relative_error(profile, gaussians, rule))
    energy = np.asarray(gaussians.total_reflectance() / profile.total_reflectance() - 1)
    radii = np.asarray(r)
    ring = radii[:, None] ** 2 * reference
    # End the line where there is hardly any light.
    relative = np.where(
        ring > _LEAST * ring.max(axis=0), fitted / np.maximum(reference, 1e-300) - 1, np.nan
    )

    figure = Figure(figsize=(10, 7.5), layout="constrained")
    linear, log, residual = figure.subplot_mosaic(
        [["linear", "log"], ["residual", "residual"]], height_ratios=(3, 2)
    ).values()

    # Draw the fit between the few radii of a measurement.
    dense = r if len(r) > _FEW else jnp.geomspace(r[0], r[-1], _POINTS, dtype=r.dtype)
    between, of_fit = np.asarray(dense), np.asarray(gaussians(dense), np.float64)
    parts = gaussian(gaussians.variances[None], (dense * dense)[:, None])
    single = np.asarray(parts * jnp.mean(gaussians.weights, axis=1)[None])
    log.loglog(between, single, color="0.75", linewidth=0.8, zorder=1)
    marker, width = (None, 3.0) if len(r) > _FEW else ("o", 0.8)
    names = channel_names(len(error))
    for channel, color in enumerate(_colors(len(error))):
        held = "held" if abs(energy[channel]) < _HELD else f"{energy[channel]:+.2e}"
        label = f"{names[channel]}: E = {error[channel]:.2e}, energy {held}"
        values = reference[:, channel]
        linear.plot(radii, radii * values, color=color, alpha=0.35, linewidth=width, marker=marker)
        linear.plot(between, between * of_fit[:, channel], color=color, linewidth=1.2, label=label)
        log.loglog(radii, values, color=color, alpha=0.35, linewidth=width, marker=marker)
        log.loglog(between, of_fit[:, channel], color=color, linewidth=1.2)
        residual.semilogx(radii, relative[:, channel], color=color, linewidth=1.2, marker=marker)

    # The radius that contains four fifths of the drawn energy in the widest channel.
    ring = np.cumsum(np.gradient(radii)[:, None] * radii[:, None] * reference, axis=0)
    core = radii[np.argmax(ring >= 0.8 * ring[-1], axis=0).max()]
    linear.set(xlabel="r (mm)", ylabel="r R(r) (1/mm)", xlim=(0, core), ylim=(0, None))
    linear.set_title("profile (wide) and fit (narrow)", fontsize="medium")
    linear.legend(fontsize="small", frameon=False)
    highest, ends = reference.max(), (radii[0], radii[-1])
    heights = (_TAIL * highest, 3 * max(highest, fitted.max()))
    log.set(xlabel="r (mm)", ylabel="R(r) (1/mm²)", xlim=ends, ylim=heights)
    log.set_title("logarithmic, with each Gaussian (gray)", fontsize="medium")
    residual.axhline(0, color="0.6", linewidth=0.8)
    residual.set(xlabel="r (mm)", ylabel="fit / R - 1", xlim=ends)
    residual.set_title("relative error where r² R(r) exceeds 1% of its maximum", fontsize="medium")
    if not rule.reaches_origin:
        nodes, weights = (np.asarray(values) for values in rule.radii(profile))
        begin = float(nodes[weights > 0].min())
        for axes in (linear, log, residual):
            axes.axvspan(axes.get_xlim()[0], begin, color="0.93", zorder=0)
        residual.text(
            begin,
            0.03,
            "not fitted ",
            ha="right",
            transform=residual.get_xaxis_transform(),
            fontsize="small",
        )
        most = 1.3 * float(np.nanmax(np.abs(relative[radii >= begin]), initial=1e-3))
        residual.set_ylim(-most, most)
    for axis in (log.xaxis, residual.xaxis):
        axis.set_minor_formatter(NullFormatter())  # their labels would overlap within a decade
    figure.suptitle(title or "")
    return figure


def _radii(profile: AbstractProfile) -> Float[Array, " radii"]:
    """Return the radii of a measured profile; otherwise radii from a hundredth of the smallest
    length scale to where every channel has fallen to the tail.
    """
    measured = profile.known_radii()
    if measured is not None:
        return measured[0][measured[0] > 0]
    scale = profile.length_scale()
    least, most = 0.02 * scale.min(), 1e3 * scale.max()
    r = jnp.geomspace(least, most, 4 * _POINTS, dtype=scale.dtype)
    values = np.asarray(profile(r))
    last = np.flatnonzero(np.any(values > _TAIL * values.max(), axis=1))[-1]
    return jnp.geomspace(least, r[last], _POINTS, dtype=r.dtype)


def _colors(channels: int) -> Sequence[str]:
    return CHANNEL_COLORS if channels == 3 else [f"C{channel}" for channel in range(channels)]


def plot_error_by_count(by_count: ErrorByCount, *, title: str | None = None) -> Figure:
    r"""Plot the error (Eq. 4) of each channel against the number of Gaussians, on a logarithmic
    axis.

    **Arguments:**

    - `by_count`: result of `error_by_count`.
    - `title`: title of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    error = np.asarray(by_count.error)
    counts = np.arange(1, len(error) + 1)
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.add_subplot()
    for channel, color in enumerate(_colors(error.shape[1])):
        axes.semilogy(counts, error[:, channel], "o-", color=color, markersize=4, linewidth=1.2)
    axes.set(xlabel="number of Gaussians", ylabel="E (Eq. 4)", xticks=counts)
    axes.grid(axis="y", color="0.9")
    figure.suptitle(title or "")
    return figure


def plot_pictures(
    rows: Sequence[Sequence[ArrayLike] | np.ndarray],
    titles: Sequence[str],
    names: Sequence[str] | None = None,
    *,
    white: float | None = None,
    inches: float = 2.6,
) -> Figure:
    r"""Draw a grid of linear-light pictures over black, encoded as sRGB.

    **Arguments:**

    - `rows`: rows of pictures `[height, width, 3]`, premultiplied by their coverage, as in a
      `Frame`.
    - `titles`: titles of the columns.
    - `names`: names of the rows.
    - `white`: value that is shown as white. By default each row has its own exposure, with 0.5% of
      the values above zero brighter than white.
    - `inches`: height of a picture.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    height, width = np.shape(rows[0][0])[:2]
    figure = Figure(
        figsize=(inches * width / height * len(titles), inches * len(rows) + 0.2),
        dpi=150,
        layout="constrained",
    )
    grid = figure.subplots(
        len(rows),
        len(titles),
        squeeze=False,
        subplot_kw={"xticks": [], "yticks": [], "frame_on": False},
    )
    for number, (line, pictures) in enumerate(zip(grid, rows, strict=True)):
        values = np.stack([np.asarray(picture, np.float64) for picture in pictures])
        lit = values[values > 0] if np.any(values > 0) else 1.0
        brightest = np.quantile(lit, _BRIGHTEST) if white is None else white
        for axes, picture in zip(line, linear_to_srgb(values / brightest), strict=True):
            axes.imshow(picture, interpolation="nearest")
        if names is not None:
            line[0].set_ylabel(names[number], fontsize="small")
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize="small")
    return figure


def plot_recovery(recovery: Recovery, *, title: str | None = None) -> Figure:
    r"""Draw each observed picture, the recovered picture, and their difference.

    Pixels that do not count are gray. The difference is the mean over the channels, divided by the
    root mean square of the picture.

    **Arguments:**

    - `recovery`: result of `recover`.
    - `title`: title of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    rows = len(recovery.pictures)
    figure = Figure(figsize=(9.5, 3.1 * rows), layout="constrained")
    axes = figure.subplots(rows, 3, squeeze=False, subplot_kw={"xticks": [], "yticks": []})
    for number, (row, recovered, residual) in enumerate(
        zip(axes, recovery.pictures, recovery.residuals, strict=True), 1
    ):
        seen = recovered - residual
        bright = float(np.nanquantile(seen, 0.99)) or 1.0
        for ax, picture, name in zip(
            row, (seen, recovered), (f"picture {number}", "recovered"), strict=False
        ):
            ax.imshow(_shown(picture, bright))
            ax.set_title(name)
        share = 100 * np.mean(residual, axis=-1) / np.sqrt(np.nanmean(seen**2))
        reach = float(np.nanquantile(np.abs(share), 0.99)) or 1.0
        image = row[2].imshow(share, cmap="RdBu_r", vmin=-reach, vmax=reach)
        row[2].set_facecolor("0.8")
        row[2].set_title("recovered less input")
        figure.colorbar(image, ax=row[2], label="% of the picture", shrink=0.8)
    figure.suptitle(title or "")
    return figure


def _shown(picture: np.ndarray, bright: float) -> np.ndarray:
    """Encode a picture for display, with three channels."""
    unknown = ~np.all(np.isfinite(picture), axis=-1, keepdims=True)
    gray = np.broadcast_to(np.mean(picture, axis=-1, keepdims=True), (*picture.shape[:2], 3))
    colors = picture if picture.shape[-1] == 3 else gray
    return np.where(unknown, 0.8, linear_to_srgb(colors / bright))
