"""A picture for any weights: what `render` makes of them, and its derivative."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import camera_over, joined, sheet, sphere

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.splatting import DenseRasterizer

pytestmark = pytest.mark.once

PLAIN = sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())
VARIANCES = (0.01, 4.0, 60.0)


def ball_over_sheet(gaussians, single=None) -> sj.Scene:
    """Before a sheet, so that one surface shows behind the other; one layer is narrower than the
    splats.
    """
    both = joined(sphere(200, 6.0, jitter=0.0), sheet(12.0, 2.0, center=(0.0, 0.0, -8.0)))
    albedo = jnp.asarray(np.random.default_rng(1).uniform(0.3, 0.9, (both.count, 2)), float)
    both = eqx.tree_at(lambda s: s.albedo, both, albedo, is_leaf=lambda leaf: leaf is None)
    light = sj.DirectionalLight([-0.5, -0.3, -1.0], [2.0, 3.0], cast_shadows=False)
    return sj.Scene(both, (light,), sj.Material(gaussians, single_scattering=single))


def gaussians_of(weights) -> sj.SumOfGaussians:
    return sj.SumOfGaussians(jnp.asarray(VARIANCES), jnp.asarray(weights, float))


ONE = [[0.1, 0.2], [0.3, 0.2], [0.2, 0.1]]
OTHER = [[0.4, 0.0], [0.0, 0.5], [0.5, 0.3]]


@pytest.fixture(scope="module")
def planned():
    """A scene, its camera, its plan, and the picture per Gaussian with its derivative."""
    scene, camera = ball_over_sheet(gaussians_of(ONE)), camera_over(14.0, 24, slant=20.0)
    plan = sj.make_plan(scene, camera, PLAIN)
    return scene, camera, plan, sj.diffusion_basis(scene, camera, PLAIN, plan, derivative=True)


def test_it_is_the_picture_of_any_weights(planned):
    _, camera, plan, gathered = planned
    assert np.sum(np.asarray(gathered.in_front) == 0) > 0  # something shows behind
    for weights in (ONE, OTHER):
        frame = sj.render(ball_over_sheet(gaussians_of(weights)), camera, PLAIN, plan)
        found = gathered.beauty(gaussians_of(weights))
        np.testing.assert_allclose(found, frame.beauty, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gathered.coverage, frame.coverage, rtol=1e-4, atol=1e-5)
    # The narrowest layer is resolved nowhere, the widest everywhere.
    _, resolved = gathered.light.weigh(gaussians_of(ONE), jnp.zeros(2))
    seen = np.asarray(gathered.leaving[0]) > 0
    narrow, middle, wide = np.asarray(resolved)[:, seen].mean(axis=1)
    assert narrow < 1e-3 < middle <= wide
    np.testing.assert_allclose(wide, 1, rtol=1e-3)


def test_its_derivative_is_that_of_the_picture(planned):
    """In weights and variances, forward and reverse."""
    start, camera, plan, gathered = planned
    jacobian = sj.picture_jacobian(start, camera, PLAIN, plan)
    gaussians, rng = start.material.gaussians, np.random.default_rng(4)
    way = jax.tree.map(lambda leaf: leaf * jnp.asarray(rng.normal(size=leaf.shape)), gaussians)
    beauty = jax.jit(lambda gaussians: gathered.beauty(gaussians))
    for other in (lambda g: g.variances, lambda g: g.weights):
        alone = eqx.tree_at(other, way, replace_fn=jnp.zeros_like)
        expected = jacobian.along(alone)
        _, found = jax.jvp(beauty, (gaussians,), (alone,))
        assert float(jnp.max(jnp.abs(expected))) > 1e-2
        np.testing.assert_allclose(found, expected, atol=1e-4 * float(jnp.max(jnp.abs(expected))))
    picture, slope = jax.jvp(beauty, (gaussians,), (way,))
    np.testing.assert_allclose(picture, jacobian.frame.beauty, rtol=1e-4, atol=1e-5)
    back = jax.vjp(beauty, gaussians)[1](picture)[0]
    along = sum(jax.tree.leaves(jax.tree.map(jnp.vdot, back, way)))
    np.testing.assert_allclose(along, jnp.vdot(picture, slope), rtol=1e-3)


def test_single_scattering_is_refused():
    medium = sj.Medium(jnp.asarray([0.1, 0.1]), jnp.asarray([1.0, 1.0]), jnp.asarray([1.3, 1.3]))
    with pytest.raises(ValueError, match=r"scene\.material has single scattering"):
        sj.diffusion_basis(
            ball_over_sheet(gaussians_of(ONE), sj.SingleScattering(medium)),
            camera_over(14.0, 24),
            PLAIN,
        )
