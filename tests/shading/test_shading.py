"""The specular lobe: reciprocity, horizon, gradients; its tabulated albedo, against quadratures of
the lobe itself. The light that a surface receives, against its formula, for every kind of light.
"""

from functools import cache, partial

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import unit
from jax.test_util import check_grads

import splatjax as sj
from splatjax.shading import (
    SurfacePoints,
    albedo_root,
    diffuse_transmission,
    directional_albedo,
    fresnel_f0,
    reflected_radiance,
    specular_lobe,
    sum_received,
)


def random_directions(count, seed):
    vectors = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    vectors[:, 2] = np.abs(vectors[:, 2])
    return vectors


def lobe_at(normal, wi, wo, f0=0.028, specular=0.18, roughness=0.3, dtype=None):
    normal, wi, wo, f0, specular, roughness = (
        jnp.asarray(x, dtype) for x in (normal, wi, wo, f0, specular, roughness)
    )
    return specular_lobe(normal, wi, wo, f0=f0, specular=specular, roughness=roughness)


UP = [[0.0, 0.0, 1.0]]


@pytest.mark.once
def test_fresnel_of_skin_and_of_no_interface(dtype):
    np.testing.assert_allclose(float(fresnel_f0(jnp.asarray(1.4, dtype))), 1 / 36, rtol=1e-6)
    assert float(fresnel_f0(jnp.asarray(1.0, dtype))) == 0


@pytest.mark.once
def test_helmholtz_reciprocity(dtype):
    wi, wo = random_directions(64, 3), random_directions(64, 4)
    there, back = lobe_at(UP, wi, wo, dtype=dtype), lobe_at(UP, wo, wi, dtype=dtype)
    np.testing.assert_allclose(there, back, rtol=1e-5)


LOBES = {
    # |wi + wo|^2 = 4 and cos a = 1: f = specular F0 / (4 pi m^2).
    "head on": (UP, UP, 0.028, 0.18, 0.3, 0.18 * 0.028 / (4 * np.pi * 0.09)),
    # A mirror pair at 60 degrees: H.V = 1/2 and H = N, and |wi + wo|^2 = 1.
    "mirrored": (
        *([[x, 0.0, 0.5]] for x in (0.75**0.5, -(0.75**0.5))),
        *(0.04, 1.0, 0.5),
        (0.04 + 0.96 * 0.5**5) / (np.pi * 0.25),
    ),
}


@pytest.mark.once
@pytest.mark.parametrize("place", LOBES)
def test_lobe_is_that_of_the_formula_with_fresnel_at_the_half_vector(place, dtype):
    *given, expected = LOBES[place]
    np.testing.assert_allclose(lobe_at(UP, *given, dtype=dtype), [expected], rtol=1e-5)


DEGENERATE = {
    "light below": ([0.3, 0.0, -0.5], [0.0, 0.0, 1.0]),
    "camera below": ([0.0, 0.0, 1.0], [0.3, 0.1, -0.2]),
    "light on the horizon": ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    "both on the horizon, opposite": ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]),
    "opposite": ([0.6, 0.0, 0.8], [-0.6, 0.0, -0.8]),
    "just above, opposite": ([1.0, 0.0, 1e-6], [-1.0, 0.0, 1e-6]),
    "just above, the same": ([1.0, 0.0, 1e-6], [1.0, 0.0, 1e-6]),
    "just above, across": ([1.0, 0.0, 1e-20], [0.0, 1.0, 1e-20]),
    "head on": ([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]),
}


@jax.jit
@partial(jax.value_and_grad, argnums=tuple(range(6)))
def total_and_slopes(normal, wi, wo, f0, specular, roughness):
    return jnp.sum(lobe_at(normal, wi, wo, f0, specular, roughness))


@pytest.mark.parametrize("place", DEGENERATE)
@pytest.mark.parametrize("roughness", [0.0, 0.05, 1.0])
def test_degenerate_places_are_finite(place, roughness, dtype):
    wi, wo = (unit([direction]) for direction in DEGENERATE[place])
    value, slopes = total_and_slopes(*arrays(dtype, UP, wi, wo, 0.028, 0.18, roughness))
    assert 0 <= float(value) < np.inf
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    if "below" in place or "horizon" in place:
        assert not any(np.any(each) for each in (value, *slopes))


@pytest.mark.once
def test_root_of_albedo_and_its_floor(dtype):
    albedo = jnp.asarray([0.0, 1e-5, 1e-4, 0.25, 1.0], dtype)
    found = jax.vmap(jax.value_and_grad(albedo_root))(albedo)
    expected = [0.01, 0.01, 0.01, 0.5, 1.0], [0, 0, 0, 1.0, 0.5]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


TABLE_ERROR = 2e-4  # of the series, as its docstring states; the design requires 1e-3
SLOPE_ERROR = 0.02
NODES = 96  # of the hemisphere's quadrature, per axis


@cache
def hemisphere():
    """Give directions and weights of `int f dw` for a lobe symmetric about the x axis.

    Nodes crowd at the horizon and about the mirror direction, where the lobe of a grazing view is
    narrow.
    """
    x, weights = np.polynomial.legendre.leggauss(NODES)
    t, weights = (1 + x) / 2, weights / 2
    cosine, azimuth = np.meshgrid(t**2, np.pi * (1 - t**3), indexing="ij")
    sine = np.sqrt(1 - cosine**2)
    ways = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    return ways.reshape(-1, 3), np.outer(weights * 2 * t, weights * 6 * np.pi * t**2).ravel()


def integrated(mu, f0, roughness):
    with jax.enable_x64(True):
        wi, weights = hemisphere()
        wo = np.asarray([[np.sqrt(1 - mu * mu), 0.0, mu]])
        return float(np.sum(jax.jit(lobe_at)(UP, wi, wo, f0, 1.0, roughness) * wi[:, 2] * weights))


def arrays(dtype, *values):
    return tuple(jnp.asarray(value, dtype) for value in values)


def leaving(mu, f0, roughness, law=((1.0,),)):
    law = sj.scattering.AngularLaw(jnp.asarray(law, mu.dtype))
    return diffuse_transmission(mu, f0, roughness, law)[0]


ALBEDO, LEAVING = jax.jit(directional_albedo), jax.jit(leaving)


def random_places(count, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.02, 1, count), rng.uniform(0.1, 1, count)


@pytest.mark.once
@pytest.mark.parametrize("f0", [0.0, 0.028, 1.0])
def test_table_is_the_integral_of_the_lobe(f0, dtype):
    mu, roughness = random_places(24, seed=1)
    truth = [integrated(m, f0, r) for m, r in zip(mu, roughness, strict=True)]
    table = ALBEDO(*arrays(dtype, mu, f0, roughness))
    np.testing.assert_allclose(np.asarray(table), truth, atol=TABLE_ERROR, rtol=0)


@pytest.mark.once
@pytest.mark.parametrize(
    ("mu", "f0", "scale", "expected"),
    [
        # d'Eon and Luebke's shader leaves out the 1/pi of the lobe; its albedos of skin, measured
        # independently, are pi times ours.
        ([1.0, 0.7, 0.4, 0.1], 0.028, np.pi, [0.0801, 0.0908, 0.211, 0.763]),
        # int PH cos dH over half vectors within 45 degrees, in closed form at normal incidence.
        (1.0, 1.0, 1.0, 0.910),
    ],
)
def test_albedos_are_those_published_and_in_closed_form(mu, f0, scale, expected, dtype):
    table = directional_albedo(*arrays(dtype, mu, f0, 0.3))
    np.testing.assert_allclose(np.asarray(table) * scale, expected, atol=1e-3)


@pytest.mark.once
def test_never_more_than_all_light(dtype):
    mu, roughness = arrays(dtype, *np.meshgrid(np.linspace(0, 1, 101), np.linspace(0.01, 1.2, 40)))
    tables = np.asarray([ALBEDO(mu, *arrays(dtype, f0), roughness) for f0 in (0.0, 0.028, 1.0)])
    assert np.all((tables >= 0) & (tables <= 1))
    assert np.all(tables[0] == 0)


@pytest.mark.once
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6, 1.0])
def test_white_furnace_in_closed_form(roughness, dtype):
    # Under uniform unit radiance a white diffuser below the interface returns, with the lobe,
    # exactly what comes in.
    mu, parameters = [0.05, 0.3, 0.7, 1.0], arrays(dtype, 0.028, roughness)
    x, weights = np.polynomial.legendre.leggauss(64)
    cosine, mu_o = arrays(dtype, (1 + x) / 2, mu)
    entering = np.pi * np.sum(weights * np.asarray(cosine * (1 - ALBEDO(cosine, *parameters))))
    diffuse = entering * np.asarray(LEAVING(mu_o, *parameters)) / np.pi
    lobe = [integrated(each, 0.028, roughness) for each in mu]
    np.testing.assert_allclose(diffuse + lobe, 1.0, atol=2e-3)
    np.testing.assert_allclose(diffuse + np.asarray(ALBEDO(mu_o, *parameters)), 1.0, atol=1e-4)


def test_slopes_agree_with_the_quadrature(float64):
    mu, roughness = random_places(12, seed=2)
    mu, roughness, step = 0.1 + 0.85 * mu, np.clip(roughness, 0.12, 0.95), 1e-3
    slopes = jax.jit(jax.grad(directional_albedo, argnums=(0, 2)))
    for m, r in zip(mu, roughness, strict=True):
        in_mu = integrated(m + step, 0.028, r) - integrated(m - step, 0.028, r)
        in_roughness = integrated(m, 0.028, r + step) - integrated(m, 0.028, r - step)
        expected = np.asarray([in_mu, in_roughness]) / (2 * step)
        np.testing.assert_allclose(slopes(m, 0.028, r), expected, rtol=SLOPE_ERROR, atol=2e-3)


VALUES_AND_SLOPES = [
    jax.jit(jax.value_and_grad(each, argnums=(0, 1, 2))) for each in (directional_albedo, leaving)
]


@pytest.mark.parametrize("mu", [-0.1, 0.0, 1e-7, 1e-5, 1.0, 1.0000001])
@pytest.mark.parametrize("roughness", [0.0, 0.05, 1.0, 1.5])
def test_borders_of_the_table_are_finite(mu, roughness, dtype):
    for value_and_slopes in VALUES_AND_SLOPES:
        for f0 in (0.0, 0.028, 1.0):
            value, slopes = value_and_slopes(*arrays(dtype, mu, f0, roughness))
            assert np.all(np.isfinite([value, *slopes]))


DIRECTIONS = np.asarray([[0.3, -2.0, -1.0], [1.0, 0.2, -0.4]])
PLACE, ORIGIN, AXIS = np.asarray([[8.0, 20.0, 15.0], [1.0, 2.0, 30.0], [0.1, 0.0, -1.0]])
STRENGTHS = np.asarray([[1.0, 2, 3], [0.5, 0.1, 0.2], [900.0, 500, 100], [4.0, 5, 6]])


@pytest.mark.parametrize("count", [20_000, 40_000])
def test_irradiance_is_the_sum_of_the_formulas(count, float32):
    """Large ones too: jaxlib 0.10.2 gets these sums wrong on CPUs at many counts, in float32."""
    body = bodies.bumpy(count)
    centers, normals = np.asarray(body.centers, float), np.asarray(body.normals, float)
    groups = sj.scene.stack_lights(
        (
            sj.DirectionalLight(DIRECTIONS[0], STRENGTHS[0]),
            sj.GaussianBeam(ORIGIN, AXIS, STRENGTHS[3], 9.0),
            sj.PointLight(PLACE, STRENGTHS[2]),
            sj.DirectionalLight(DIRECTIONS[1], STRENGTHS[1]),
            sj.scene.SpotLight(PLACE, -PLACE, STRENGTHS[2], 5, 15),
        )
    )
    rng, visible, shares = np.random.default_rng(0), [], {}
    for group in groups:
        share = rng.uniform(size=(len(group.light_indices), count))
        visible.append(jnp.asarray(share, jnp.float32) if group.lights.cast_shadows else None)
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
    point = received(unit(away)) / np.sum(away**2, axis=1)
    inner, outer = np.cos(np.radians([5, 15]))
    t = np.clip((unit(away) @ unit(PLACE) - outer) / (inner - outer), 0, 1)
    assert (np.min(t), np.max(t)) == (0, 1)
    arriving = [
        received(-unit(DIRECTIONS[0])) * shares[0],
        received(-unit(AXIS)) * beam,
        point * shares[2],
        received(-unit(DIRECTIONS[1])) * shares[3],
        point * (3 * t**2 - 2 * t**3) * shares[4],
    ]
    expected = STRENGTHS[[0, 3, 2, 1, 2]].T @ arriving
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


EDGES = np.asarray([[3.0, 0, 0], [0, 2.0, 0]])
EVEN = (np.arange(300) + 0.5) / 300
SQUARES = np.stack(np.meshgrid(EVEN - 0.5, EVEN - 0.5), -1).reshape(-1, 2) @ EDGES
RINGS = np.stack([np.outer(np.sqrt(EVEN), f(2 * np.pi * EVEN)).ravel() for f in (np.cos, np.sin)])
RINGS = np.pad(RINGS, ((0, 1), (0, 0))).T
SEEN_FROM = np.asarray([[0, 0, 0.3], [0.9, 0.1, 0.25], [1.3, 0.8, 0.3], [-4, 3, 1], [1, 2, 90.0]])
LIGHTS = {
    "rectangle": (sj.scene.RectangleLight([0] * 3, 1, EDGES), 6, SQUARES, 1e-4),
    "disk": (sj.scene.DiskLight([0] * 3, 1, [0, 0, 1], 1), np.pi, RINGS, 0.01),
}


@pytest.mark.once
@pytest.mark.parametrize("kind", LIGHTS)
def test_the_solid_angle_is_the_sum_over_its_area(kind, dtype):
    light, area, places, most = LIGHTS[kind]
    offset = SEEN_FROM[:, None] - places
    exact = area * np.mean(offset[..., 2] / np.linalg.norm(offset, axis=-1) ** 3, axis=1)
    np.testing.assert_allclose(light.solid_angle(jnp.asarray(SEEN_FROM, dtype)), exact, rtol=most)
    assert np.all(light.solid_angle(jnp.asarray(-SEEN_FROM, dtype)) == 0)
    ball = sj.scene.SphereLight([0] * 3, 1, 1.0).solid_angle(jnp.asarray(SEEN_FROM[3:], dtype))
    cone = np.sqrt(1 - 1 / np.sum(SEEN_FROM[3:] ** 2, axis=1))
    np.testing.assert_allclose(ball, 2 * np.pi * (1 - cone), rtol=1e-4)


FACING = unit(random_directions(8, 8) + np.asarray([0, 0, 3.0]))
SHAPES = [*(light for light, *_ in LIGHTS.values()), sj.scene.SphereLight([0] * 3, 1, 1.0)]


@pytest.mark.parametrize(
    ("function", "arguments", "how"),
    [
        (
            lobe_at,
            (FACING, random_directions(8, 6), random_directions(8, 7), 0.05, 0.5, 0.4),
            {"order": 2, "rtol": 1e-5},
        ),
        (
            leaving,
            ([0.07, 0.4, 0.9], 0.05, [0.2, 0.5, 0.8], [[0.8], [0.3], [-0.1]]),
            {"order": 1, "rtol": 1e-5, "eps": 1e-6},
        ),
        (
            lambda mu: directional_albedo(mu, *arrays(None, 0.05, 0.3)),
            (0.4,),
            {"order": 2, "rtol": 1e-5, "eps": 1e-6},
        ),
        (
            lambda place, way, inner, outer, points: sj.scene.SpotLight(
                place, way, STRENGTHS[2], inner, outer
            ).incidence(points),
            (PLACE, -PLACE, 3.0, 40.0, PLACE * [[0.3], [0.5]] + [[1, 0, 3], [-2, 1, 0]]),
            {"order": 2},
        ),
        (
            lambda x: [light.solid_angle(x) for light in SHAPES],
            (SEEN_FROM[2:],),
            {"order": 1, "rtol": 1e-5},
        ),
    ],
    ids=["lobe", "leaving", "twice in the cosine", "spot", "solid angles"],
)
def test_gradients_in_every_argument(float64, function, arguments, how):
    check_grads(jax.jit(function), arrays(None, *arguments), modes=["rev"], **how)


@pytest.mark.once
def test_the_highlight_below_the_end_of_a_tube_is_that_of_its_samples():
    """The point that is mirrored is near, and the center far away. One point stands for all that
    the lobe sees: a third too bright.
    """
    tube = sj.scene.RectangleLight([0, 0, 100], 1, [[1000, 0, 0], [0, -20, 0]], count=200)
    points = [[450.0, 0, 0], [460.0, 5, 0]], UP * 2, unit([[0.3, 0, 1]] * 2), [1.0] * 2, [0.3] * 2
    surface = SurfacePoints(*arrays(float, *points), [None])
    ours, exact = (
        reflected_radiance(surface, sj.scene.stack_lights(lights), jnp.asarray(0.03), 1)
        for lights in ((tube,), tube.samples())
    )
    np.testing.assert_allclose(ours / exact, 1.37, atol=0.1)
