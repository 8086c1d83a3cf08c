"""Screen-space diffusion: on a frontal plane it is a convolution, and one kernel is not the sum of
its Gaussians.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import camera_over, hits
from planes import spots
from scipy.signal import fftconvolve

import splatjax as sj
from splatjax import baselines

SIZE, HALF = 128, 12.0
TWO = sj.SumOfGaussians(
    jnp.asarray([0.3, 2.0], float), jnp.asarray([[0.5, 0.4, 0.3], [0.5, 0.6, 0.7]], float)
)
ONE = sj.SumOfGaussians(jnp.full(2, 1.0), jnp.full((2, 3), 0.5))  # in two halves
CAMERA = camera_over(HALF, SIZE)
INSIDE = slice(SIZE // 4, -SIZE // 4)


def flat(light: np.ndarray) -> sj.Frame:
    """The buffers of a frontal plane that carries this light and reflects all of it."""
    position = jnp.asarray(hits(CAMERA), float)
    ones, none = jnp.ones((SIZE, SIZE)), jnp.zeros((SIZE, SIZE, 3))
    normal = none.at[..., 2].set(1.0)
    depth, irradiance = 40 * HALF * ones, jnp.asarray(light, float)
    shadow, layers, weights = ones[None], none[None], jnp.ones((1, 3))
    given = none, ones, depth, position, normal, none + 1, shadow, irradiance, layers, weights
    return sj.Frame(*given, none, none, jnp.zeros(1), jnp.zeros(()))


@eqx.filter_jit
def exitance(frame, gaussians, kernel):
    material = sj.Material(gaussians, eta=1.0, specular=0.0)
    return jnp.pi * baselines.diffuse_on_screen(frame, CAMERA, material, kernel).diffuse


def edge(points: np.ndarray) -> np.ndarray:
    return np.repeat((points[:, :1] > 0.7) * 1.0, 3, axis=1)


LIGHTS = {
    light: light(hits(CAMERA)[..., :2].reshape(-1, 2)).reshape(SIZE, SIZE, 3)
    for light in (spots, edge)
}
PASSES, SHIPPED = baselines.GaussianPasses(reach=32), baselines.ShippedKernel()
PREINTEGRATED = baselines.PreintegratedKernel()


@pytest.mark.once
@pytest.mark.parametrize(
    ("light", "gaussians", "kernel", "least", "most"),
    [
        pytest.param(spots, TWO, PASSES, 0, 2e-4, id="passes"),  # 1.9e-5
        # The ends of its taps, at twice the root of the mean squared distance.
        pytest.param(spots, ONE, SHIPPED, 0, 5e-2, id="shipped, of one"),  # 3.8e-2
        pytest.param(spots, TWO, SHIPPED, 8e-2, 1, id="shipped, of two"),  # 9.0e-2
        pytest.param(edge, TWO, PREINTEGRATED, 0, 4e-2, id="preintegrated, edge"),  # 3.5e-2
        pytest.param(edge, TWO, SHIPPED, 6e-2, 1, id="shipped, edge"),  # 6.3e-2
        pytest.param(spots, TWO, PREINTEGRATED, 6e-2, 1, id="preintegrated, spots"),  # 6.8e-2
    ],
)
def test_passes_are_the_convolution_and_one_kernel_is_for_one_gaussian_or_along_edges_alone(
    light, gaussians, kernel, least, most
):
    """The shipped kernel is right for one Gaussian, the preintegrated one along straight edges.
    Of the peak, away from the edges of the picture.
    """
    step = 2 * HALF / SIZE
    line = np.arange(-SIZE // 2, SIZE // 2 + 1) * step
    profile = step**2 * gaussians(jnp.hypot(*jnp.meshgrid(line, line)))
    truth = fftconvolve(LIGHTS[light], profile, mode="same", axes=(0, 1))
    off = np.abs(np.asarray(exitance(flat(LIGHTS[light]), gaussians, kernel)) - truth)
    assert least < np.max(off[INSIDE, INSIDE]) / np.max(truth) < most


@pytest.mark.once
@pytest.mark.parametrize("kernel", [PASSES, SHIPPED])
def test_constant_light_stays_constant_and_does_not_jump_to_another_surface(kernel):
    """The right half of the picture lies 100 mm farther away, and is dark; a corner shows
    nothing.
    """
    y, x = np.indices((SIZE, SIZE))
    right, corner = x >= SIZE // 2, x + y < 20
    lit = ~right & ~corner
    frame = flat(np.repeat(lit[..., None], 3, axis=2))
    depth = np.where(corner, np.inf, np.asarray(frame.depth) + 100 * right)
    depth, coverage = (jnp.asarray(each, float) for each in (depth, ~corner))
    frame = dataclasses.replace(frame, depth=depth, coverage=coverage)
    found = np.asarray(exitance(frame, TWO, kernel))
    np.testing.assert_allclose(found[lit], 1.0, rtol=1e-5)
    np.testing.assert_allclose(found[~lit], 0.0, atol=1e-6)
