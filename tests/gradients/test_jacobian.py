"""The Jacobian of a picture in its material: equal to reverse mode row by row, and to the fit's own
derivative behind it. How derivatives compose with `jit`, `vmap` and `lax.map`.
"""

import dataclasses
from functools import cache, partial

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import FAST, PLAIN, WORLDS, view

import splatjax as sj

pytestmark = [pytest.mark.slow, pytest.mark.once, pytest.mark.usefixtures("double")]

SIZE = 32
ROW_BY_ROW = 1e-5  # required; 1e-12 measured


def scene(single: bool) -> sj.Scene:
    """A bumpy ball with albedo; an unresolved layer, one of splats, and one of clusters."""
    albedo = np.random.default_rng(12).uniform(0.2, 0.9, (300, 2))
    splats = bodies.with_albedo(bodies.bumpy(300), albedo)
    gaussians = sj.SumOfGaussians([1.3, 12.0, 150.0], [[0.3, 0.2], [0.2, 0.3], [0.2, 0.2]])
    medium = sj.Medium([0.1, 0.05], [0.9, 1.2], [1.3, 1.0])
    once = sj.SingleScattering(medium) if single else None
    light = sj.DirectionalLight([-1.0, -0.4, -0.1], [2.0, 3.0], cast_shadows=False)
    return sj.Scene(splats, (light,), sj.Material(gaussians, single_scattering=once))


CAMERA = ((6.0, 4.0, 40.0), 32.0, SIZE)


@pytest.mark.long
def test_it_is_reverse_mode_row_by_row():
    start, camera = scene(True), view(*CAMERA)
    plan = sj.make_plan(start, camera, FAST)
    jacobian = sj.picture_jacobian(start, camera, FAST, plan)
    assert float(jacobian.frame.overflow) == 0

    def beauty(gaussians):
        moved = eqx.tree_at(lambda s: s.material.gaussians, start, gaussians)
        return sj.render(moved, camera, FAST, plan).beauty

    @jax.jit
    def some_rows(gaussians, rows):
        picture, pull = jax.vjp(beauty, gaussians)
        return picture, jax.lax.map(lambda row: pull(row.reshape(picture.shape))[0], rows)

    lit = np.flatnonzero(jacobian.frame.beauty)
    places = np.random.default_rng(2).choice(lit, 300, replace=False)
    rows = jnp.eye(jacobian.frame.beauty.size)[places]
    picture, expected = some_rows(start.material.gaussians, rows)
    np.testing.assert_allclose(jacobian.frame.beauty, picture, rtol=1e-12, atol=1e-15)
    variances, weights = (
        np.asarray(each).reshape(len(each), -1)[:, places].T
        for each in (jacobian.variances, jacobian.weights)
    )
    for ours, theirs in ((variances, expected.variances), (weights, expected.weights.sum(axis=2))):
        norm = np.linalg.norm(theirs, axis=1)
        assert np.all(norm > 0)
        assert np.max(np.linalg.norm(ours - theirs, axis=1) / norm) < ROW_BY_ROW
    # Under light that grazes, single scattering leaves less to the Gaussians: then a weight moves
    # the light that enters.
    assert np.min(np.asarray(jacobian.weights)) < 0


def gaussians_of(coefficients):
    return sj.fit_gaussians(sj.Dipole(sj.Medium(**coefficients, eta=1.3)), 2, throw=False).gaussians


def test_through_the_fit_it_is_the_derivative_in_the_coefficients():
    """The picture's change along the change of the fit."""
    coefficients = {
        "sigma_a": jnp.asarray([0.02, 0.05]),
        "sigma_s_prime": jnp.asarray([0.4, 0.6]),
    }
    start, camera = scene(False), view(*CAMERA)
    start = eqx.tree_at(lambda s: s.material.gaussians, start, gaussians_of(coefficients))
    plan = sj.make_plan(start, camera, PLAIN)

    def fitted(name, at, by):
        return gaussians_of(coefficients | {name: coefficients[name].at[at].multiply(1 + by)})

    of_gaussians = sj.picture_jacobian(start, camera, PLAIN, plan)
    jacobian = of_gaussians.through(gaussians_of, coefficients)
    assert jacobian["sigma_a"].shape == (SIZE, SIZE, 2, 2)
    step = 1e-4
    for name, found in jacobian.items():
        for at, value in enumerate(coefficients[name]):
            ends = fitted(name, at, step), fitted(name, at, -step)
            slope = jax.tree.map(lambda a, b, v=value: (a - b) / (2 * step * v), *ends)
            expected = of_gaussians.along(slope.variances, slope.weights)
            largest = np.max(np.abs(expected))
            assert largest > 0
            np.testing.assert_allclose(
                found[..., at], expected, rtol=ROW_BY_ROW, atol=1e-7 * largest
            )
    bodies.assert_refused(
        lambda: of_gaussians.through(lambda w: sj.SumOfGaussians(jnp.ones(1), w), jnp.ones((1, 2))),
        r"weights has shape \[1, 2\], not \[2, 2\]",
    )


@cache
def graph(path: str):
    world = WORLDS["sun and beam"].make()
    settings = {"fast": FAST, "plain": PLAIN}[path]
    other = dataclasses.replace(view((2.0, -4.0, 41.0)), principal_point=[0.5, 0.5])
    plan = sj.make_plan(world.scene, [world.camera, other], settings)

    def parts(scene):
        return scene.material.gaussians.weights, scene.lights[1].origin

    def loss(point, camera):
        scene = eqx.tree_at(parts, world.scene, point)
        return jnp.mean(sj.render(scene, camera, settings, plan).beauty ** 2)

    return loss, parts(world.scene), [world.camera, other]


@pytest.mark.long
def test_many_cameras_by_map_and_many_materials_by_vmap_are_those_one_by_one():
    loss, point, cameras = graph("fast")
    gradient = jax.grad(loss)
    alone = jax.jit(gradient)(point, cameras[1])
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    over_cameras = jax.vmap(gradient, in_axes=(None, 0))
    for mapped in (lambda *given: jax.lax.map(partial(gradient, given[0]), given[1]), over_cameras):
        found = jax.jit(mapped)(point, stacked)
        bodies.assert_close([each[1] for each in found], alone, rtol=1e-9, atol=1e-13)


def test_the_plain_path_has_forward_mode_and_second_derivatives():
    loss, point, (camera, _) = graph("plain")
    rng = np.random.default_rng(7)
    way = tuple(jnp.asarray(rng.normal(size=each.shape)) for each in point)

    @jax.jit
    def derivatives(point):
        """Compute the loss and its gradient, and how both change along the way."""
        gradient = jax.value_and_grad(lambda point: loss(point, camera))
        return jax.jvp(gradient, (point,), (way,))

    step = 1e-5
    ((_, gradient), (slope, product)), *ends = (
        derivatives(tuple(p + s * w for p, w in zip(point, way, strict=True)))
        for s in (0, step, -step)
    )
    np.testing.assert_allclose(slope, sum(map(jnp.vdot, gradient, way)), rtol=1e-9)
    for found, above, below in zip(product, ends[0][0][1], ends[1][0][1], strict=True):
        expected = (above - below) / (2 * step)
        assert np.max(np.abs(expected)) > 0
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8 * np.max(np.abs(expected)))


def test_the_fast_path_has_a_gradient_in_one_input_alone_and_refuses_forward_mode_in_words():
    """That the layers' places and widths stay is not an error."""
    loss, point, (camera, _) = graph("fast")
    of_light = jax.grad(lambda origin: loss((point[0], origin), camera))
    assert jax.eval_shape(of_light, point[1]).shape == point[1].shape
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda p: loss(p, camera), (point,), (point,))


@pytest.mark.once
@pytest.mark.parametrize("derivative", ["reverse", "jacobian"])
def test_products_are_in_full_precision_on_every_device(derivative):
    """The default of GPUs, 11 bits, makes a picture wrong by 2% and a derivative by all of it."""
    start, camera = scene(single=False), view(*CAMERA)
    plan = sj.make_plan(start, camera)
    compute = {
        "reverse": jax.grad(lambda s: jnp.mean(sj.render(s, camera, plan=plan).beauty)),
        "jacobian": lambda s: eqx.filter(sj.picture_jacobian(s, camera, plan=plan), eqx.is_array),
    }
    program = str(jax.make_jaxpr(compute[derivative])(start))
    products = program.count("dot_general[")
    assert products > 5
    assert program.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") == products
