"""What plots of fits, and of errors over counts, must show."""

import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
from bodies import assert_refused

import splatjax as sj
from splatjax.plots import plot_error_by_count, plot_fit, plot_pictures


def test_a_figure_has_names_units_error_and_energy_and_is_drawn_outside_of_pyplot(
    float64, tmp_path
):
    gaussians = sj.load_material("marble").gaussians
    model = sj.fitting.TransportModel()
    profile = model.profile(sj.load_medium("marble"))
    figure = plot_fit(profile, gaussians, rule=model.rule, title="marble")
    assert [axes.get_xlabel() for axes in figure.axes] == ["r (mm)"] * 3
    assert "1/mm²" in figure.axes[1].get_ylabel()
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels[0].startswith("red: E = 2.7")
    assert [label.partition(":")[0] for label in labels] == ["red", "green", "blue"]
    assert all(label.endswith("energy held") for label in labels)
    assert matplotlib.pyplot.get_fignums() == []
    figure.savefig(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_a_perfect_fit_of_one_channel_and_the_energy_that_another_misses():
    gaussians = sj.SumOfGaussians([0.1, 2.0], [[0.3], [0.4]])
    less = sj.SumOfGaussians(gaussians.variances, 0.99 * gaussians.weights)
    perfect, misses = (plot_fit(gaussians, fit).axes for fit in (gaussians, less))
    assert np.nanmax(np.abs(perfect[2].lines[0].get_ydata())) == 0
    assert misses[0].get_legend().get_texts()[0].get_text().endswith("energy -1.00e-02")


def test_what_was_not_fitted_is_shaded_and_not_counted():
    """A photon beam is infinite at the origin: only a rule with a cut has an error at all."""
    beam = sj.scattering.PhotonBeam(sj.Medium(0.0041, 2.62, 1.5))
    rule = sj.scattering.L2_QUADRATURE.beyond(0.5)
    gaussians = sj.SumOfGaussians([0.5, 9.0], [0.2, 0.4])
    error = float(sj.fitting.relative_error(beam, gaussians, rule)[0])
    figure = plot_fit(beam, gaussians, rule=rule)
    assert f"E = {error:.2e}" in figure.axes[0].get_legend().get_texts()[0].get_text()
    for axes in figure.axes[1:]:
        (shade,) = [
            patch for patch in axes.patches if patch.get_facecolor()[:3] == (0.93, 0.93, 0.93)
        ]
        np.testing.assert_allclose(shade.get_x() + shade.get_width(), 0.5 / 2.6241, rtol=0.05)
    assert_refused(lambda: plot_fit(beam, gaussians), r"like 1/r.*rule=")


def test_nothing_to_count_or_to_see_is_drawn_too():
    fit, rule = sj.SumOfGaussians([1.0], [1.0]), sj.scattering.L2_QUADRATURE.beyond(200.0)
    assert len(plot_fit(sj.Dipole(sj.Medium(0.1, 1.0, 1.3)), fit, rule=rule).axes) == 3
    (axes,) = plot_pictures([[np.zeros((4, 4, 3))]], ["black"]).axes
    assert not np.any(axes.images[0].get_array())


def test_few_radii_are_marked_and_the_fit_is_drawn_between_them():
    radii = jnp.asarray([0.5, 1.0, 2.0, 4.0, 8.0])
    table = sj.scattering.Tabulated(radii, jnp.exp(-radii)[:, None])
    given, drawn = plot_fit(table, sj.SumOfGaussians([1.0], [1.0])).axes[0].lines
    assert given.get_marker() == "o"
    np.testing.assert_allclose(given.get_xdata(), radii)
    assert len(drawn.get_xdata()) > 100
    np.testing.assert_allclose(drawn.get_xdata()[[0, -1]], [0.5, 8.0], rtol=1e-5)


def test_every_count_and_channel_is_drawn_on_a_logarithmic_axis():
    error = jnp.asarray([[0.3, 0.2, 0.1], [0.03, 0.02, 0.01]])
    counts = sj.fitting.ErrorByCount(error, jnp.ones((2, 2)))
    axes = plot_error_by_count(counts, title="three").axes[0]
    assert axes.get_yscale() == "log"
    assert "E" in axes.get_ylabel()
    np.testing.assert_array_equal(axes.get_xticks(), [1, 2])
    np.testing.assert_array_equal([line.get_ydata() for line in axes.lines], np.asarray(error).T)
