"""The light that enters, against its formula, for every kind of light."""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion import entering_irradiance
from splatjax.scene import DirectionalLight, GaussianBeam, PointLight, stack_lights


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.mark.parametrize("count", [300, 20_000, 40_000])
def test_irradiance_is_the_sum_of_the_formulas(count, dtype):
    """Large ones too: jaxlib 0.10.2 gets these sums wrong on CPUs at many counts, in float32."""
    body = bodies.bumpy(count)
    centers, normals = np.asarray(body.centers, float), np.asarray(body.normals, float)
    directions = np.asarray([[0.3, -2.0, -1.0], [1.0, 0.2, -0.4]])
    place, origin, axis = (
        np.asarray([8.0, 20.0, 15.0]),
        np.asarray([1.0, 2.0, 30.0]),
        np.asarray([0.1, 0.0, -1.0]),
    )
    one, two, three, four = np.asarray(
        [[1.0, 2, 3], [0.5, 0.1, 0.2], [900.0, 500, 100], [4.0, 5, 6]]
    )

    def array(values):
        return jnp.asarray(values, dtype)

    lights = (
        DirectionalLight(array(directions[0]), array(one)),
        GaussianBeam(array(origin), array(axis), array(four), array(9.0)),
        PointLight(array(place), array(three)),
        DirectionalLight(array(directions[1]), array(two)),
    )
    groups = stack_lights(lights)
    rng = np.random.default_rng(0)
    lit = [
        rng.uniform(size=(len(group.places), count)) if group.lights.cast_shadows else None
        for group in groups
    ]
    share = {
        place: lit[i][row]
        for i, g in enumerate(groups)
        if lit[i] is not None
        for row, place in enumerate(g.places)
    }

    found = jax.jit(
        lambda points, normals, lit: entering_irradiance(
            points, normals, groups, lit, lambda c: (0.9 - 0.2 * c)[None], 3
        ),
    )(body.centers, body.normals, [None if each is None else array(each) for each in lit])

    def received(wi):
        cosine = np.maximum(np.sum(wi * normals, axis=1), 0)
        return cosine * (0.9 - 0.2 * cosine)

    away = place - centers
    offset = centers - origin
    across = offset - np.sum(offset * unit(axis), axis=1, keepdims=True) * unit(axis)
    beam = np.exp(-np.sum(across**2, axis=1) / 18) / (18 * np.pi)
    expected = np.outer(one, received(-unit(directions[0])) * share[0])
    expected += np.outer(four, received(-unit(axis)) * beam)
    expected += np.outer(three, received(unit(away)) / np.sum(away**2, axis=1) * share[2])
    expected += np.outer(two, received(-unit(directions[1])) * share[3])
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-4, atol=1e-6)


def test_no_light_is_dark():
    body = bodies.bumpy(20)
    found = entering_irradiance(body.centers, body.normals, [], [], lambda c: c[None], 3)
    assert found.shape == (3, 20)
    assert not np.any(np.asarray(found))
