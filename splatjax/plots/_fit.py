"""A profile, the Gaussians fitted to it, and what they leave."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from splatjax._format import channel_names
from splatjax.fitting import relative_error
from splatjax.gaussians import AbstractProfile, SumOfGaussians, gaussian
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

_RGB = ("#c0392b", "#27853f", "#2c5aa0")
_POINTS = 400
_TAIL = 1e-7
"""Share of its peak down to which a profile is drawn."""
_FEW = 60
"""Radii of a measurement, up to which each is marked."""
_HELD = 1e-6
"""Relative error of the energy that is rounding."""


def plot_fit(
    profile: AbstractProfile,
    gaussians: SumOfGaussians,
    *,
    rule: AbstractRadialRule = L2_QUADRATURE,
    title: str | None = None,
) -> Figure:
    r"""Draw a profile and its fit, on linear and on logarithmic axes, and the difference between
    them.

    Three channels are drawn in red, green and blue; the single
    Gaussians of the fit, with the mean weight of the channels, in gray. Of a measurement each
    radius is marked. The legend gives the error (Eq. 4) and the energy of the fit relative to the
    profile's, minus 1: held, if that is rounding.

    **Arguments:**

    - `profile`: the reference, 1/mm^2.
    - `gaussians`: the fit, with as many channels.
    - `rule`: that of the fit. Radii before it begins are shaded, and do not count.
    - `title`: of the figure.

    **Returns:** a matplotlib `Figure`, which no window shows; `figure.savefig(path)` writes it.
    """
    r = _radii(profile)
    reference, fitted = (np.asarray(model(r), np.float64) for model in (profile, gaussians))
    error = np.asarray(relative_error(profile, gaussians, rule))
    energy = np.asarray(gaussians.total_reflectance() / profile.total_reflectance() - 1)
    radii = np.asarray(r)
    colors, names = colors_of(len(error)), channel_names(len(error))

    figure = Figure(figsize=(10, 7.5), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 2))
    linear, log, residual = (
        figure.add_subplot(grid[0, 0]),
        figure.add_subplot(grid[0, 1]),
        figure.add_subplot(grid[1, :]),
    )

    dense = (
        r if len(r) > _FEW else jnp.geomspace(r[0], r[-1], _POINTS, dtype=r.dtype)
    )  # what the fit is between few radii
    between, of_fit = np.asarray(dense), np.asarray(gaussians(dense), np.float64)
    marker, width = (None, 3.0) if len(r) > _FEW else ("o", 0.8)
    for part in single_gaussians(gaussians, dense).T:
        log.loglog(between, part, color="0.75", linewidth=0.8, zorder=1)
    for channel, color in enumerate(colors):
        held = "held" if abs(energy[channel]) < _HELD else f"{energy[channel]:+.2e}"
        label = f"{names[channel]}: E = {error[channel]:.2e}, energy {held}"
        linear.plot(
            radii,
            radii * reference[:, channel],
            color=color,
            alpha=0.35,
            linewidth=width,
            marker=marker,
        )
        linear.plot(between, between * of_fit[:, channel], color=color, linewidth=1.2, label=label)
        log.loglog(
            radii, reference[:, channel], color=color, alpha=0.35, linewidth=width, marker=marker
        )
        log.loglog(between, of_fit[:, channel], color=color, linewidth=1.2)
        difference = radii * (fitted[:, channel] - reference[:, channel])
        share = difference / np.max(radii * reference[:, channel])
        residual.semilogx(radii, share, color=color, linewidth=1.2, marker=marker)

    linear.set(
        xlabel="r (mm)", ylabel="r R(r) (1/mm)", xlim=(0, _core(radii, reference)), ylim=(0, None)
    )
    linear.set_title("profile (wide) and fit (narrow)", fontsize="medium")
    linear.legend(fontsize="small", frameon=False)
    bottom = _TAIL * reference.max()
    log.set(
        xlabel="r (mm)",
        ylabel="R(r) (1/mm²)",
        xlim=(radii[0], radii[-1]),
        ylim=(bottom, 3 * max(reference.max(), fitted.max())),
    )
    log.set_title("logarithmic, with each Gaussian (gray)", fontsize="medium")
    residual.axhline(0, color="0.6", linewidth=0.8)
    residual.set(xlabel="r (mm)", ylabel="r (fit - R) / max r R", xlim=(radii[0], radii[-1]))
    residual.set_title("residual", fontsize="medium")
    if not rule.reaches_origin:
        _shade(rule, profile, (log, residual))
        counts = radii >= _begin(rule, profile)
        left = radii[:, None] * (fitted - reference) / np.max(radii[:, None] * reference, axis=0)
        residual.set_ylim(1.3 * min(left[counts].min(), -1e-3), 1.3 * max(left[counts].max(), 1e-3))
    for axis in (log.xaxis, residual.xaxis):
        axis.set_minor_formatter(
            NullFormatter()
        )  # over less than a decade their labels would overlap
    if title is not None:
        figure.suptitle(title)
    return figure


def _begin(rule: AbstractRadialRule, profile: AbstractProfile) -> float:
    """The radius, mm, from which on some channel is fitted."""
    r, dr = (np.asarray(each) for each in rule.radii(profile))
    return float(r[dr > 0].min())


def _shade(rule: AbstractRadialRule, profile: AbstractProfile, axes: Sequence[Axes]) -> None:
    for each in axes:
        each.axvspan(each.get_xlim()[0], _begin(rule, profile), color="0.93", zorder=0)
    axes[-1].text(
        _begin(rule, profile),
        0.03,
        "not fitted ",
        ha="right",
        transform=axes[-1].get_xaxis_transform(),
        fontsize="small",
    )


def colors_of(channels: int) -> Sequence[str]:
    """Give a color for each channel: red, green and blue for three."""
    return _RGB if channels == 3 else [f"C{channel}" for channel in range(channels)]


def _radii(profile: AbstractProfile) -> Float[Array, " radii"]:
    """Those of a measured profile; else from a hundredth of the smallest length scale to where
    every channel has fallen to the tail."""
    known = profile.known_radii()
    if known is not None:
        return known[0][known[0] > 0]
    scale = np.asarray(profile.length_scale(), np.float64)
    r = jnp.geomspace(
        0.02 * scale.min(), 1e3 * scale.max(), 4 * _POINTS, dtype=profile.length_scale().dtype
    )
    values = np.asarray(profile(r))
    visible = np.any(values > _TAIL * values.max(), axis=1)
    last = np.flatnonzero(visible)[-1]
    return jnp.geomspace(r[0], r[last], _POINTS, dtype=r.dtype)


def _core(radii: np.ndarray, reference: np.ndarray) -> float:
    """The radius within which a channel keeps four fifths of the energy that is drawn, of the
    widest channel.
    """
    ring = np.cumsum(np.gradient(radii)[:, None] * radii[:, None] * reference, axis=0)
    within = np.argmax(ring >= 0.8 * ring[-1], axis=0)
    return float(radii[within.max()])


def single_gaussians(gaussians: SumOfGaussians, r: Float[Array, " radii"]) -> np.ndarray:
    """Give each Gaussian of a sum, with the mean weight of the channels: [radii, gaussians]."""
    shape = (*r.shape, *gaussians.variances.shape)
    values = gaussian(
        jnp.broadcast_to(gaussians.variances, shape), jnp.broadcast_to((r * r)[:, None], shape)
    )
    return np.asarray(values * jnp.broadcast_to(jnp.mean(gaussians.weights, axis=1), shape))
