"""The light that a surface receives, against its formula, for every kind of light."""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import unit

from splatjax.scene import DirectionalLight, GaussianBeam, PointLight, stack_lights
from splatjax.shading import sum_received

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
