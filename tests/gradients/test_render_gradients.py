"""The gradient of a whole picture, for everything that is a float, against central differences in float64.

A step must change neither which splats are visible nor which surface a shadow map sees; at 1e-6 of a parameter's scale the
chosen directions do not.
"""

from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.splatting import DenseRasterizer, ShadowSettings, TileRasterizer

pytestmark = [pytest.mark.slow, pytest.mark.once]  # compiles five renderers, in float64 whatever the precision of the run

COUNT, SIZE = 300, 24
STEP = 1e-6  # of a parameter's own scale
AGREEMENT = 1e-4  # relative; rounding over the step leaves about 1e-8
SHADOWS = ShadowSettings(resolution=32, bias=1.5, softness=3.0)
SETTINGS = {
    "fast": sj.RenderSettings(shadows=SHADOWS, rasterizer=TileRasterizer(lanes=8, slots=16)),
    "plain": sj.RenderSettings(shadows=SHADOWS, rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()),
}


def scene() -> sj.Scene:
    body = bodies.bumpy(COUNT)
    rng = np.random.default_rng(12)
    albedo = jnp.asarray(rng.uniform(0.2, 0.9, (COUNT, 2)))
    splats = sj.Splats(body.centers, body.normals, body.radii, body.areas, albedo)
    gaussians = sj.SumOfGaussians(jnp.asarray([4.0, 30.0]), jnp.asarray([[0.5, 0.3], [0.2, 0.6]]))
    lights = (
        sj.DirectionalLight(jnp.asarray([-0.6, -0.4, -0.7]), jnp.asarray([2.0, 3.0]), cast_shadows=False),
        sj.PointLight(jnp.asarray([-14.0, 18.0, 25.0]), jnp.asarray([900.0, 500.0])),
    )
    return sj.Scene(splats, lights, sj.Material(gaussians))


def camera() -> sj.Camera:
    return sj.Camera.look_at(jnp.asarray([6.0, 4.0, 40.0]), jnp.zeros(3), fov=32.0, width=SIZE, height=SIZE)


PARAMETERS = {
    "weights": lambda s: s.material.gaussians.weights,
    "variances": lambda s: s.material.gaussians.variances,
    "eta": lambda s: s.material.eta,
    "roughness": lambda s: s.material.roughness,
    "albedo": lambda s: s.splats.albedo,
    "centers": lambda s: s.splats.centers,
    "normals": lambda s: s.splats.normals,
    "radii": lambda s: s.splats.radii,
    "areas": lambda s: s.splats.areas,
    "light direction": lambda s: s.lights[0].direction,
    "light irradiance": lambda s: s.lights[0].irradiance,
    "light position": lambda s: s.lights[1].position,
    "light intensity": lambda s: s.lights[1].intensity,
}


@cache
def rendered(kind):
    """Scene, gradient of the mean of `beauty`, and a function that gives that mean."""
    start, settings = scene(), SETTINGS[kind]
    plan = sj.plan(start, camera(), settings)

    @jax.jit
    def mean_and_gradient(scene, camera):
        def mean(scene, camera):
            frame = sj.render(scene, camera, settings, plan)
            return jnp.mean(frame.beauty), frame.overflow

        return jax.value_and_grad(mean, argnums=(0, 1), has_aux=True)(scene, camera)

    (_, overflow), gradient = mean_and_gradient(start, camera())
    assert float(overflow) == 0
    return start, gradient, lambda s, c=None: float(mean_and_gradient(s, camera() if c is None else c)[0][0])


def quotient(function, leaf, direction, step):
    return (function(leaf + step * direction) - function(leaf - step * direction)) / (2 * step)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("kind", SETTINGS)
def test_gradient_is_that_of_central_differences(kind, name):
    with jax.enable_x64(True):
        start, (gradient, _), mean = rendered(kind)
        leaf, derivative = PARAMETERS[name](start), np.asarray(PARAMETERS[name](gradient))
        assert np.all(np.isfinite(derivative))
        direction = np.random.default_rng(len(name)).normal(size=leaf.shape)
        if name == "normals":  # they are unit vectors: turn them
            normals = np.asarray(leaf)
            direction -= np.sum(direction * normals, axis=1, keepdims=True) * normals
        direction = jnp.asarray(direction * np.mean(np.abs(leaf)))
        difference = quotient(lambda x: mean(eqx.tree_at(PARAMETERS[name], start, x)), leaf, direction, STEP)
    expected = np.vdot(derivative, direction)
    assert abs(difference) > 1e-7
    np.testing.assert_allclose(expected, difference, rtol=AGREEMENT)


@pytest.mark.parametrize("kind", SETTINGS)
def test_gradient_in_the_camera_is_that_of_central_differences(kind):
    with jax.enable_x64(True):
        start, (_, gradient), mean = rendered(kind)
        for where in (lambda c: c.position, lambda c: c.focal_length):
            leaf = where(camera())
            direction = jnp.asarray(np.random.default_rng(3).normal(size=leaf.shape))
            difference = quotient(lambda x, w=where: mean(start, eqx.tree_at(w, camera(), x)), leaf, direction, STEP)
            np.testing.assert_allclose(np.vdot(where(gradient), direction), difference, rtol=AGREEMENT)


def test_forward_mode_of_the_plain_path_is_its_reverse_mode():
    with jax.enable_x64(True):
        start, (gradient, _), _ = rendered("plain")
        plan = sj.plan(start, camera(), SETTINGS["plain"])
        rng = np.random.default_rng(21)
        tangent = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), start)

        @jax.jit
        def forward(scene, tangent):
            return jax.jvp(lambda s: jnp.mean(sj.render(s, camera(), SETTINGS["plain"], plan).beauty), (scene,), (tangent,))[1]

        products = jax.tree.map(lambda g, t: float(jnp.vdot(g, t)), gradient, tangent)
        found, expected = float(forward(start, tangent)), sum(jax.tree.leaves(products))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_fast_and_plain_gradients_agree():
    """But for the support of the Gaussians, and what clusters and coarse points leave."""
    with jax.enable_x64(True):
        gradients = {kind: rendered(kind)[1][0] for kind in SETTINGS}
    for name in ("weights", "albedo", "normals", "light irradiance", "light position"):
        where = PARAMETERS[name]
        fast, plain = (np.asarray(where(gradients[kind])) for kind in ("fast", "plain"))
        error = np.linalg.norm(fast - plain) / np.linalg.norm(plain)
        assert error < 0.02, (name, error)
