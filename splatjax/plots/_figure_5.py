"""Figure 5: the same quality from fewer splats, as long as their radius grows."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from splatjax.baselines import ThinnedDiffuser, layer_contrast, thinning_error
from splatjax.diffusion import DenseDiffuser, DiffusionSettings, ExitOdds, PlainMean
from splatjax.gaussians import SumOfGaussians
from splatjax.render import RenderSettings, diffuse, light_on_splats, plan
from splatjax.scene import Material

from ._subject import Subject, bright, picture_grid

_AMPLIFIED = (2.0, 4.0, 8.0, 16.0)
_KEEP = (1, 4, 16, 64)
_FACTOR = 1.5


def figure_5(
    subject: Subject, *, amplified: tuple[float, ...] = _AMPLIFIED, keep: tuple[int, ...] = _KEEP
) -> Figure:
    r"""Draw layers of increasing radius made of fewer and fewer splats, each with its error; below,
    the law of that error.

    The horizontal axis amplifies the radius, the vertical one leaves splats out. Along a diagonal
    the quality stays: a radius twice as large allows a quarter of the splats.

    **Arguments:**

    - `subject`: the body.
    - `amplified`: widths of the layers, in spacings of the splats; 2 or more, or a layer is not
      resolved.
    - `keep`: one of how many splats stays, row by row; the first is what the others are compared
      with.

    **Returns:** a matplotlib `Figure`. Errors are root mean squares over the picture, of the
    layer's own.

    **Source:** Kim et al. 2010, Figure 5.
    """
    spacing = float(np.sqrt(np.mean(np.asarray(subject.splats.areas))))
    widths = spacing * np.asarray(amplified)
    weights = jnp.full((len(widths), 3), 1 / len(widths))
    scene = subject.scene(Material(SumOfGaussians(jnp.asarray(widths**2, weights.dtype), weights)))
    settings = RenderSettings(
        diffuser=DenseDiffuser(),
        diffusion=DiffusionSettings(normalization=PlainMean(depth=ExitOdds().depth)),
    )
    found = plan(scene, subject.camera, settings)
    source = light_on_splats(scene, found, settings).source.T
    layers = []
    for number in keep:
        thinned = eqx.tree_at(lambda plan: plan.diffuser, found, ThinnedDiffuser(number))
        own = replace(settings, diffuser=ThinnedDiffuser(number))
        layers.append(
            np.asarray(jax.block_until_ready(diffuse(scene, source, subject.camera, own, thinned)))
        )
    exact = layers[0]
    scale = np.sqrt(np.sum(exact**2, axis=(1, 2, 3)))
    measured = np.stack(
        [np.sqrt(np.sum((each - exact) ** 2, axis=(1, 2, 3))) / scale for each in layers]
    )
    contrast = jnp.asarray(
        [
            layer_contrast(scene.splats, source, jnp.asarray(width**2, source.dtype))
            for width in widths
        ]
    )
    ratios = 1 / np.asarray(keep)
    lengths = jnp.asarray(widths)[None], jnp.asarray(spacing)
    predicted = np.asarray(thinning_error(*lengths, jnp.asarray(ratios)[:, None], contrast[None]))

    factor = bright([exact[0]])
    names = ["all splats" if number == 1 else f"1 of {number}" for number in keep]
    titles = [
        f"radius x {each:g}, {width:.1f} mm" for each, width in zip(amplified, widths, strict=True)
    ]
    figure = picture_grid(
        [[factor * layer for layer in line] for line in layers],
        titles,
        names,
        inches=2.2,
        below=3.2,
    )
    for axes, error in zip(figure.axes, measured.ravel(), strict=True):
        if error > 0:
            axes.text(
                0.03,
                0.03,
                f"{100 * error:.1f}%",
                color="white",
                fontsize="small",
                transform=axes.transAxes,
            )
    _draw_law(figure, widths / spacing, ratios, measured, predicted, contrast)
    return figure


def _draw_law(figure: Figure, amplified, ratios, measured, predicted, contrast) -> None:
    high = 2.45 / figure.get_figheight()
    law = figure.add_axes((0.09, 0.55 / figure.get_figheight(), 0.38, high))
    frontier = figure.add_axes((0.58, 0.55 / figure.get_figheight(), 0.38, high))
    reach = np.geomspace(0.6 * predicted[1:].min(), 1.6 * predicted[1:].max(), 50)
    law.fill_between(
        reach, reach / _FACTOR, reach * _FACTOR, color="0.9", linewidth=0, label="factor 1.5"
    )
    law.plot(reach, reach, color="0.4", linewidth=1)
    for column, each in enumerate(amplified):
        law.plot(
            predicted[1:, column],
            measured[1:, column],
            "o",
            markersize=4,
            label=f"radius x {each:g}",
        )
    law.set(xscale="log", yscale="log", xlabel="error by the law", ylabel="error in the picture")
    law.legend(fontsize="x-small", frameon=False)
    radii = np.geomspace(amplified[0], amplified[-1], 60)
    s = np.interp(np.log(radii), np.log(amplified), contrast)
    ratio = np.geomspace(0.5 * ratios[-1], 1, 60)
    error = thinning_error(
        jnp.asarray(radii)[None],
        jnp.asarray(1.0),
        jnp.asarray(ratio)[:, None],
        jnp.asarray(s)[None],
    )
    lines = frontier.contour(
        radii,
        ratio,
        np.asarray(error),
        levels=(0.003, 0.01, 0.03, 0.1, 0.3),
        colors="0.2",
        linewidths=1,
    )
    frontier.clabel(lines, fmt=lambda level: f"{100 * level:g}%", fontsize="x-small")
    frontier.plot(
        *(each.ravel() for each in np.meshgrid(amplified, ratios)), "o", color="C3", markersize=4
    )
    frontier.set(
        xscale="log", yscale="log", xlabel="amplification of the radius", ylabel="ratio of splats"
    )
    frontier.set_xticks(amplified, [f"{each:g}" for each in amplified])
    frontier.minorticks_off()
