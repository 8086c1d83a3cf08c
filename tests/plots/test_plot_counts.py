"""What a plot of errors over counts must show."""

import jax.numpy as jnp
import numpy as np

from splatjax.fitting import ErrorByCount
from splatjax.plots import plot_error_by_count


def test_every_count_and_channel_is_drawn_on_a_logarithmic_axis():
    error = jnp.asarray([[0.3, 0.2, 0.1], [0.03, 0.02, 0.01]])
    axes = plot_error_by_count(ErrorByCount(error, jnp.ones((2, 2))), title="three").axes[0]
    assert axes.get_yscale() == "log"
    assert "E" in axes.get_ylabel()
    np.testing.assert_array_equal(axes.get_xticks(), [1, 2])
    np.testing.assert_array_equal([line.get_ydata() for line in axes.lines], np.asarray(error).T)
