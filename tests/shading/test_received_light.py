"""The light that a surface receives, against its formula, for every kind of light."""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import unit
from jax.test_util import check_grads

from splatjax.scene import (
    DirectionalLight,
    DiskLight,
    GaussianBeam,
    PointLight,
    RectangleLight,
    SphereLight,
    stack_lights,
)
from splatjax.shading import SurfacePoints, reflected_radiance, sum_received

DIRECTIONS = np.asarray([[0.3, -2.0, -1.0], [1.0, 0.2, -0.4]])
PLACE, ORIGIN, AXIS = np.asarray([[8.0, 20.0, 15.0], [1.0, 2.0, 30.0], [0.1, 0.0, -1.0]])
STRENGTHS = np.asarray([[1.0, 2, 3], [0.5, 0.1, 0.2], [900.0, 500, 100], [4.0, 5, 6]])


@pytest.mark.parametrize("count", [300, 20_000, 40_000])
def test_irradiance_is_the_sum_of_the_formulas(count, dtype):
    """Large ones too: jaxlib 0.10.2 gets these sums wrong on CPUs at many counts, in float32."""
    body = bodies.bumpy(count)
    centers, normals = np.asarray(body.centers, float), np.asarray(body.normals, float)
    groups = stack_lights(
        (
            DirectionalLight(DIRECTIONS[0], STRENGTHS[0]),
            GaussianBeam(ORIGIN, AXIS, STRENGTHS[3], 9.0),
            PointLight(PLACE, STRENGTHS[2]),
            DirectionalLight(DIRECTIONS[1], STRENGTHS[1]),
        )
    )
    rng, visible, shares = np.random.default_rng(0), [], {}
    for group in groups:
        share = rng.uniform(size=(len(group.light_indices), count))
        visible.append(jnp.asarray(share, dtype) if group.lights.cast_shadows else None)
        shares |= dict(zip(group.light_indices, share, strict=True))
    found = jax.jit(
        lambda visible: sum_received(
            body.centers, body.normals, groups, visible, lambda _, c: (0.9 - 0.2 * c)[None], 3
        )
    )(visible)

    def received(wi):
        cosine = np.maximum(np.sum(wi * normals, axis=1), 0)
        return cosine * (0.9 - 0.2 * cosine)

    away, offset = PLACE - centers, centers - ORIGIN
    across = offset - np.sum(offset * unit(AXIS), axis=1, keepdims=True) * unit(AXIS)
    beam = np.exp(-np.sum(across**2, axis=1) / 18) / (18 * np.pi)
    expected = np.outer(STRENGTHS[0], received(-unit(DIRECTIONS[0])) * shares[0])
    expected += np.outer(STRENGTHS[3], received(-unit(AXIS)) * beam)
    point = received(unit(away)) / np.sum(away**2, axis=1)
    expected += np.outer(STRENGTHS[2], point * shares[2])
    expected += np.outer(STRENGTHS[1], received(-unit(DIRECTIONS[1])) * shares[3])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


EDGES = np.asarray([[3.0, 0, 0], [0, 2.0, 0]])
EVEN = (np.arange(300) + 0.5) / 300
SQUARES = np.stack(np.meshgrid(EVEN - 0.5, EVEN - 0.5), -1).reshape(-1, 2) @ EDGES
RINGS = np.stack([np.outer(np.sqrt(EVEN), f(2 * np.pi * EVEN)).ravel() for f in (np.cos, np.sin)])
RINGS = np.pad(RINGS, ((0, 1), (0, 0))).T
SEEN_FROM = np.asarray([[0, 0, 0.3], [0.9, 0.1, 0.25], [1.3, 0.8, 0.3], [-4, 3, 1], [1, 2, 90.0]])
LIGHTS = {
    "rectangle": (RectangleLight([0] * 3, 1, EDGES), 6, SQUARES, 1e-4),
    "disk": (DiskLight([0] * 3, 1, [0, 0, 1], 1), np.pi, RINGS, 0.01),
}


@pytest.mark.parametrize("kind", LIGHTS)
def test_the_solid_angle_is_the_sum_over_its_area(kind, dtype):
    light, area, places, most = LIGHTS[kind]
    offset = SEEN_FROM[:, None] - places
    exact = area * np.mean(offset[..., 2] / np.linalg.norm(offset, axis=-1) ** 3, axis=1)
    np.testing.assert_allclose(light.solid_angle(jnp.asarray(SEEN_FROM, dtype)), exact, rtol=most)
    assert np.all(light.solid_angle(jnp.asarray(-SEEN_FROM, dtype)) == 0)
    ball = SphereLight([0] * 3, 1, 1.0).solid_angle(jnp.asarray(SEEN_FROM[3:], dtype))
    cone = np.sqrt(1 - 1 / np.sum(SEEN_FROM[3:] ** 2, axis=1))
    np.testing.assert_allclose(ball, 2 * np.pi * (1 - cone), rtol=1e-4)


def test_solid_angles_have_derivatives(float64):
    for light in (LIGHTS["rectangle"][0], LIGHTS["disk"][0], SphereLight([0] * 3, 1, 1.0)):
        angles = jax.jit(lambda x, light=light: light.solid_angle(x))
        check_grads(angles, (jnp.asarray(SEEN_FROM[2:]),), 1, rtol=1e-5)


@pytest.mark.once
def test_the_highlight_below_the_end_of_a_tube_is_that_of_its_samples():
    """The point that is mirrored is near, and the center far away. One point stands for all that
    the lobe sees: a third too bright.
    """
    tube = RectangleLight([0, 0, 100], 1, [[1000, 0, 0], [0, -20, 0]], count=200)
    samples = stack_lights(tube.samples())
    one, up = jnp.ones(2), jnp.asarray([[0, 0, 1.0]] * 2)
    points = jnp.asarray([[450.0, 0, 0], [460.0, 5, 0]]), up, jnp.asarray(unit([[0.3, 0, 1]] * 2))
    surface = SurfacePoints(*points, one, 0.3 * one, [None])
    ours, exact = (
        reflected_radiance(surface, groups, jnp.asarray(0.03), 1)
        for groups in (stack_lights((tube,)), samples)
    )
    np.testing.assert_allclose(ours / exact, 1.37, atol=0.1)
