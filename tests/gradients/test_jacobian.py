"""The Jacobian of a picture in its material: equal to reverse mode row by row, and to the fit's own
derivative behind it.
"""

from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import FAST, PLAIN, view

import splatjax as sj

pytestmark = [pytest.mark.slow, pytest.mark.once]

SIZE = 32
ROW_BY_ROW = 1e-5  # asked; 1e-12 measured


def scene(single: bool) -> sj.Scene:
    """A bumpy ball with albedo; an unresolved layer, one of splats, and one of clusters."""
    body = bodies.bumpy(300)
    albedo = jnp.asarray(np.random.default_rng(12).uniform(0.2, 0.9, (body.count, 2)))
    splats = sj.Splats(body.centers, body.normals, body.radii, body.areas, albedo)
    gaussians = sj.SumOfGaussians([1.3, 12.0, 150.0], [[0.3, 0.2], [0.2, 0.3], [0.2, 0.2]])
    medium = sj.Medium([0.1, 0.05], [0.9, 1.2], [1.3, 1.0])
    once = sj.SingleScattering(medium) if single else None
    light = sj.DirectionalLight([-1.0, -0.4, -0.1], [2.0, 3.0], cast_shadows=False)
    return sj.Scene(splats, (light,), sj.Material(gaussians, single_scattering=once))


CAMERA = ((6.0, 4.0, 40.0), 32.0, SIZE)
CASES = {"fast": (FAST, True), "plain": (PLAIN, False)}


@cache
def rendered(case: str):
    settings, single = CASES[case]
    start, camera = scene(single), view(*CAMERA)
    plan = sj.make_plan(start, camera, settings)

    def beauty(gaussians):
        return sj.render(
            eqx.tree_at(lambda s: s.material.gaussians, start, gaussians), camera, settings, plan
        ).beauty

    return start, beauty, plan, sj.picture_jacobian(start, camera, settings, plan)


@pytest.mark.long
def test_it_is_reverse_mode_row_by_row():
    """With every part that a material can have."""
    with jax.enable_x64(True):
        start, beauty, _, jacobian = rendered("fast")
        assert float(jacobian.frame.overflow) == 0
        gaussians = start.material.gaussians

        @jax.jit
        def some_rows(gaussians, places):
            picture, pull = jax.vjp(beauty, gaussians)

            def row(place):
                return pull(jnp.zeros(picture.size).at[place].set(1.0).reshape(picture.shape))[0]

            return picture, jax.lax.map(row, places)

        lit = np.flatnonzero(np.asarray(jacobian.frame.beauty).reshape(-1))
        places = jnp.asarray(np.random.default_rng(2).choice(lit, 300, replace=False))
        picture, expected = some_rows(gaussians, places)
    np.testing.assert_allclose(jacobian.frame.beauty, picture, rtol=1e-12, atol=1e-15)
    y, x, channel = np.unravel_index(np.asarray(places), picture.shape)
    weights = np.zeros(expected.weights.shape)
    weights[np.arange(300), :, channel] = np.asarray(jacobian.weights)[:, y, x, channel].T
    variances = np.asarray(jacobian.variances)[:, y, x, channel].T
    for ours, theirs in ((weights, expected.weights), (variances, expected.variances)):
        norm = np.linalg.norm(np.asarray(theirs).reshape(300, -1), axis=1)
        error = np.linalg.norm((ours - np.asarray(theirs)).reshape(300, -1), axis=1)
        assert np.all(norm > 0)
        assert np.max(error / norm) < ROW_BY_ROW
    # Under light that grazes, single scattering leaves less to the Gaussians: then a weight moves
    # the light that enters.
    assert np.min(np.asarray(jacobian.weights)) < 0


def test_along_a_change_it_is_the_forward_derivative_of_the_plain_path():
    rng = np.random.default_rng(5)
    with jax.enable_x64(True):
        start, beauty, plan, jacobian = rendered("plain")
        change = jax.tree.map(
            lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), start.material.gaussians
        )
        expected = jax.jit(lambda g, c: jax.jvp(beauty, (g,), (c,))[1])(
            start.material.gaussians, change
        )

        @jax.jit
        def along(gaussians):
            moved = eqx.tree_at(lambda s: s.material.gaussians, start, gaussians)
            return sj.picture_jacobian(moved, view(*CAMERA), PLAIN, plan).along(change)

        np.testing.assert_allclose(
            along(start.material.gaussians), jacobian.along(change), rtol=1e-9, atol=1e-12
        )
        found = jacobian.along(change)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.max(np.abs(expected)))


def medium_of(coefficients):
    sigma_a, sigma_s_prime = coefficients["sigma_a"], coefficients["sigma_s_prime"]
    return sj.Medium(sigma_a, sigma_s_prime, jnp.full_like(sigma_a, 1.3))


def gaussians_of(coefficients):
    return sj.fit_gaussians(sj.Dipole(medium_of(coefficients)), 3, throw=False).gaussians


def test_through_the_fit_it_is_the_derivative_in_the_coefficients():
    """Against reverse mode through profile, fit and picture at once, pixel by pixel."""
    with jax.enable_x64(True):
        coefficients = {
            "sigma_a": jnp.asarray([0.02, 0.05]),
            "sigma_s_prime": jnp.asarray([0.4, 0.6]),
        }
        start, camera = scene(False), view(*CAMERA)
        start = eqx.tree_at(lambda s: s.material.gaussians, start, gaussians_of(coefficients))
        plan = sj.make_plan(start, camera, PLAIN)

        def beauty(coefficients):
            moved = eqx.tree_at(lambda s: s.material.gaussians, start, gaussians_of(coefficients))
            return sj.render(moved, camera, PLAIN, plan).beauty

        jacobian = sj.picture_jacobian(start, camera, PLAIN, plan).through(
            gaussians_of, coefficients
        )
        places = [(16, 16, 0), (12, 20, 1), (20, 12, 1)]

        @jax.jit
        def rows(coefficients):
            picture, pull = jax.vjp(beauty, coefficients)
            return [pull(jnp.zeros_like(picture).at[place].set(1.0))[0] for place in places]

        expected = rows(coefficients)
    assert jacobian["sigma_a"].shape == (SIZE, SIZE, 2, 2)
    for place, row in zip(places, expected, strict=True):
        for name, each in row.items():
            assert np.max(np.abs(each)) > 0
            np.testing.assert_allclose(
                jacobian[name][place], each, rtol=ROW_BY_ROW, atol=1e-9 * np.max(np.abs(each))
            )


def test_a_function_of_other_gaussians_is_refused():
    with jax.enable_x64(True):
        *_, jacobian = rendered("plain")
        with pytest.raises(
            ValueError,
            match=r"has \[2, 2\] Gaussians and channels, the picture was made with \[3, 2\]",
        ):
            jacobian.through(lambda w: sj.SumOfGaussians(jnp.ones(2), w), jnp.ones((2, 2)))
