"""A picture for any weights: what `render` makes of them, and its derivative."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import camera_over, sheet, sphere

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
    ball, plate = sphere(200, 6.0), sheet(2.0, 12.0)
    both = [
        jnp.concatenate([getattr(ball, name), getattr(plate, name)])
        for name in ("centers", "normals", "radii", "areas")
    ]
    both[0] = both[0] - jnp.concatenate(
        [jnp.zeros((200, 3)), jnp.tile(jnp.asarray([[0.0, 0, 8]]), (plate.count, 1))]
    )
    albedo = jnp.asarray(np.random.default_rng(1).uniform(0.3, 0.9, (len(both[2]), 2)), float)
    light = sj.DirectionalLight(
        jnp.asarray([-0.5, -0.3, -1.0]), jnp.asarray([2.0, 3.0]), cast_shadows=False
    )
    return sj.Scene(
        sj.Splats(*both, albedo), (light,), sj.Material(gaussians, single_scattering=single)
    )


def gaussians_of(weights) -> sj.SumOfGaussians:
    return sj.SumOfGaussians(jnp.asarray(VARIANCES), jnp.asarray(weights, float))


ONE = [[0.1, 0.2], [0.3, 0.2], [0.2, 0.1]]
OTHER = [[0.4, 0.0], [0.0, 0.5], [0.5, 0.3]]


def test_it_is_the_picture_of_any_weights():
    camera = camera_over(14.0, 24, slant=20.0)
    plan = sj.make_plan(ball_over_sheet(gaussians_of(ONE)), camera, PLAIN)
    gathered = sj.diffusion_basis(ball_over_sheet(gaussians_of(ONE)), camera, PLAIN, plan)
    assert np.sum(np.asarray(gathered.in_front) == 0) > 0  # something shows behind
    for weights in (ONE, OTHER):
        frame = sj.render(ball_over_sheet(gaussians_of(weights)), camera, PLAIN, plan)
        found = gathered.beauty(gaussians_of(weights))
        np.testing.assert_allclose(found, frame.beauty, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gathered.coverage, frame.coverage, rtol=1e-4, atol=1e-5)
    # The narrowest layer is handed to the surface everywhere, the widest nowhere.
    narrow, middle, wide = np.asarray(gathered.light.resolved())
    assert narrow < 1e-3 < middle
    assert middle <= wide
    np.testing.assert_allclose(wide, 1, rtol=1e-3)


def test_its_derivative_is_that_of_the_picture():
    """In weights and variances, forward and reverse."""
    camera = camera_over(14.0, 24, slant=20.0)
    start = ball_over_sheet(gaussians_of(ONE))
    plan = sj.make_plan(start, camera, PLAIN)
    gathered = sj.diffusion_basis(start, camera, PLAIN, plan, derivative=True)
    jacobian = sj.picture_jacobian(start, camera, PLAIN, plan)
    rng = np.random.default_rng(4)
    way = jax.tree.map(
        lambda leaf: leaf * jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype), gaussians_of(ONE)
    )

    def beauty(gaussians):
        return gathered.beauty(gaussians)

    picture, slope = jax.jvp(jax.jit(beauty), (gaussians_of(ONE),), (way,))
    np.testing.assert_allclose(picture, jacobian.frame.beauty, rtol=1e-4, atol=1e-5)
    for part in ("weights", "variances"):
        alone = jax.tree.map(jnp.zeros_like, way)
        alone = eqx.tree_at(lambda g, part=part: getattr(g, part), alone, getattr(way, part))
        expected = jacobian.along(alone)
        _, found = jax.jvp(jax.jit(beauty), (gaussians_of(ONE),), (alone,))
        assert float(jnp.max(jnp.abs(expected))) > 1e-2
        np.testing.assert_allclose(found, expected, atol=1e-4 * float(jnp.max(jnp.abs(expected))))
    back = jax.vjp(beauty, gaussians_of(ONE))[1](picture)[0]
    along = sum(
        jnp.vdot(*pair) for pair in zip(jax.tree.leaves(back), jax.tree.leaves(way), strict=True)
    )
    np.testing.assert_allclose(along, jnp.vdot(picture, slope), rtol=1e-3)


def test_single_scattering_is_refused():
    medium = sj.Medium(jnp.asarray([0.1, 0.1]), jnp.asarray([1.0, 1.0]), jnp.asarray([1.3, 1.3]))
    with pytest.raises(ValueError, match=r"scene\.material has single scattering"):
        sj.diffusion_basis(
            ball_over_sheet(gaussians_of(ONE), sj.SingleScattering(medium)),
            camera_over(14.0, 24),
            PLAIN,
        )
