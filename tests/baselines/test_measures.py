"""How far pictures are from each other, against other people's code and by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from splatjax import baselines


@pytest.fixture
def pictures():
    random = np.random.default_rng(3)
    row, column = np.indices((40, 33)) / 10
    first = (
        np.stack([np.sin(row) * np.cos(column), np.cos(row + column), np.sin(row * column)], axis=2)
        * 0.4
        + 0.5
    )
    return first, np.clip(first + 0.1 * random.normal(size=first.shape), 0, 1)


@pytest.mark.once
def test_similarity_is_that_of_other_code(pictures):
    first, second = (jnp.asarray(each, float) for each in pictures)
    theirs = structural_similarity(
        *pictures,
        channel_axis=2,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert float(baselines.similarity(first, second)) == pytest.approx(theirs, abs=1e-4)
    assert float(baselines.similarity(first, first)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.once
def test_points_are_off_by_their_worst_channel_of_the_root_mean_square():
    truth = np.tile([[1.0, 2.0]], (100, 1))
    found = truth.copy()
    found[0], found[1, 1] = [1.3, 2.0], 1.8
    off = baselines.Off.of(found, truth)
    assert off.median == 0
    assert off.largest == pytest.approx(0.3)
    assert 0.1 <= off.most < 0.3
    assert off.rms == pytest.approx(np.sqrt((0.09 + 0.01) / 200))


@pytest.mark.once
def test_halves_are_the_left_of_one_and_the_right_of_the_other():
    left, right = jnp.zeros((2, 4, 3)), jnp.ones((2, 4, 3)).at[0, 0].set(0.01)
    found = baselines.half_and_half(left, right, gain=4.0)
    assert np.array_equal(np.asarray(found.halves)[..., 0], [[0, 0, 1, 1]] * 2)
    assert float(found.difference[0, 0, 0]) == pytest.approx(0.54)
    assert float(found.difference[1, 1, 0]) == 1.0
