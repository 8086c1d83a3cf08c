"""How derivatives compose with `jit`, `vmap` and `lax.map`, and which kinds there are on which
path.
"""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import FAST, PLAIN, WORLDS

import splatjax as sj

pytestmark = [pytest.mark.slow, pytest.mark.once]


@cache
def graph(path: str):
    """A small world: a loss of its weights and of where its beam starts, and cameras to take the
    picture with.
    """
    world = WORLDS["sun and beam"].make()
    settings = {"fast": FAST, "plain": PLAIN}[path]
    other = sj.Camera.look_at(
        jnp.asarray([2.0, -4.0, 41.0]), jnp.zeros(3), fov=32.0, width=20, height=20
    )
    plan = sj.make_plan(world.scene, [world.camera, other], settings)

    def parts(scene):
        return scene.material.gaussians.weights, scene.lights[1].origin

    def loss(point, camera):
        scene = eqx.tree_at(parts, world.scene, point)
        return jnp.mean(sj.render(scene, camera, settings, plan).beauty ** 2)

    return loss, parts(world.scene), [world.camera, other]


@pytest.mark.long
def test_many_cameras_by_map_and_many_materials_by_vmap_are_those_one_by_one():
    with jax.enable_x64(True):
        loss, point, cameras = graph("fast")
        gradient = jax.grad(loss)
        alone = jax.jit(gradient)(point, cameras[1])
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
        mapped = jax.jit(
            lambda cameras: jax.lax.map(lambda camera: gradient(point, camera), cameras)
        )(stacked)
        mapped_over = jax.jit(jax.vmap(gradient, in_axes=(None, 0)))(point, stacked)
    for found in (mapped, mapped_over):
        for ours, theirs in zip(found, alone, strict=True):
            np.testing.assert_allclose(ours[1], theirs, rtol=1e-9, atol=1e-13)


def test_the_plain_path_has_second_derivatives():
    """The product of the Hessian with a direction, forward over reverse, is the difference of
    gradients.
    """
    with jax.enable_x64(True):
        loss, point, (camera, _) = graph("plain")
        rng = np.random.default_rng(7)
        way = tuple(jnp.asarray(rng.normal(size=each.shape)) for each in point)

        @jax.jit
        def gradient_and_product(point):
            return jax.jvp(lambda p: jax.grad(loss)(p, camera), (point,), (way,))

        step = 1e-5
        (_, product), *ends = (
            gradient_and_product(tuple(p + s * w for p, w in zip(point, way, strict=True)))
            for s in (0, step, -step)
        )
        for found, above, below in zip(product, ends[0][0], ends[1][0], strict=True):
            expected = (above - below) / (2 * step)
            assert np.max(np.abs(expected)) > 0
            np.testing.assert_allclose(
                found, expected, rtol=1e-5, atol=1e-8 * np.max(np.abs(expected))
            )


def test_the_fast_path_refuses_forward_mode_in_words():
    with jax.enable_x64(True):
        loss, point, (camera, _) = graph("fast")
        with pytest.raises(TypeError, match="forward-mode"):
            jax.jvp(lambda p: loss(p, camera), (point,), (point,))


def test_a_traced_scene_needs_a_plan():
    world = WORLDS["sun and beam"].make()
    with pytest.raises(ValueError, match="a plan is needed"):
        jax.grad(lambda c: jnp.mean(sj.render(world.scene, c).beauty))(world.camera)
