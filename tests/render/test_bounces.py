"""Light that leaves the body and enters it again, against the exact series in a spherical cup: two
elements of the inside of a sphere see each other alike, wherever they lie.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
    assert_refused,
    irradiance,
    joined,
    sheet,
    sphere,
    splats,
    two_gaussians,
    unit,
    with_albedo,
)
from jax.test_util import check_grads

import splatjax as sj
from splatjax.baselines import LightAtPixels

RADIUS = 10.0
CAMERA = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=24, width=16, height=16)
MATTE = sj.Material(two_gaussians(), eta=1.0, specular=0.0)
# Of a form factor: rims end half a spacing late, and what lies within half a spacing of a splat's
# plane is not seen.
FORM_FACTOR = 0.03


COUNT = 1500  # of all bodies, which so share programs


def cup(angle: float, count: int = COUNT) -> sj.Splats:
    """The inside of a sphere, up to an angle from its lowest point, in degrees."""
    share, i = (1 - np.cos(np.radians(angle))) / 2, np.arange(count) + 0.5
    z, turn = 2 * share * i / count - 1, np.pi * (1 + 5**0.5) * i
    across = np.sqrt(1 - z * z)
    u = np.stack([np.cos(turn) * across, np.sin(turn) * across, z], axis=1)
    area = 4 * np.pi * RADIUS**2 * share / count
    return splats(RADIUS * u, -u, 1.5 * np.sqrt(area), np.full(count, area))


def received(scene: sj.Scene, bounces: int) -> np.ndarray:
    return irradiance(scene, replace(PLAIN, bounces=bounces, kernel=sj.diffusion.PlainMean()))


LAMP = sj.PointLight([0, 0, 0], [100, 200, 300], cast_shadows=False)
SUN = sj.DirectionalLight([0, 0, -1], [1, 2, 3], cast_shadows=False)
SINGLE = sj.SingleScattering(sj.Medium([0.2, 0.5, 1.0], [1.0, 1.0, 1.0], eta=1.4))
MATERIALS = {
    "matte": MATTE,
    "glossy": sj.Material(two_gaussians(), specular=1.0, roughness=0.4),
    "with single scattering": sj.Material(
        two_gaussians(), eta=1.0, specular=0.0, single_scattering=SINGLE
    ),
}


@pytest.mark.once
@pytest.mark.parametrize(
    ("material", "angle"), [("matte", 90), ("glossy", 180), ("with single scattering", 90)]
)
def test_a_cup_has_the_exact_series(material, angle):
    """Under a lamp in its center, which lights it evenly, `E_n = E_0 sum_k (t R f)^k`."""
    material = MATERIALS[material]
    mu, weights = np.polynomial.legendre.leggauss(32)
    mu, weights = jnp.asarray(0.5 + 0.5 * mu, float), jnp.asarray(0.5 * weights, float)
    surface = sj.shading.fresnel_f0(material.eta), jnp.full_like(mu, material.roughness)
    enters = 1 - 2 * jnp.sum(weights * mu * sj.shading.directional_albedo(mu, *surface))
    body = with_albedo(cup(angle), np.full((COUNT, 3), [0.9, 0.5, 0.7]))
    share = (1 - np.cos(np.radians(angle))) / 2
    returned = np.asarray(enters * material.total_reflectance() * body.albedo[0]) * share
    scene = sj.Scene(body, LAMP, material)
    before, term = received(scene, 0).mean(axis=1), 1.0
    first, added = before, material.total_reflectance() / material.gaussians.total_reflectance()
    for bounces in (1, 2) if material.single_scattering is None else (1,):
        after, term = received(scene, bounces).mean(axis=1), term * returned
        error = bounces * FORM_FACTOR
        np.testing.assert_allclose((after - before) / first, added * term, rtol=error)
        before = after


@pytest.mark.once
def test_a_convex_body_receives_nothing_of_itself():
    body = sphere(COUNT)
    scene = sj.Scene(body, (SUN, LAMP), MATTE)
    np.testing.assert_array_equal(received(scene, 2), received(scene, 0))
    # A rough one little: its splats face each other, and are no higher than their neighbors.
    rough = body.normals + 0.2 * np.random.default_rng(1).normal(size=(COUNT, 3))
    scene = sj.Scene(replace(body, normals=unit(rough)), SUN, MATTE)
    direct, bounced = received(scene, 0), received(scene, 1)
    assert np.mean(bounced - direct) < 0.01 * np.mean(direct)


@pytest.mark.once
def test_opposite_squares_receive_by_their_form_factor():
    """Two squares of 20 mm, 20 mm apart: 0.1998 of what leaves one arrives at the other."""
    lower, upper = sheet(9.75, 0.5), sheet(9.75, 0.5, (0.0, 0.0, -1.0), (0.0, 0.0, 20.0))
    scene = sj.Scene(joined(lower, upper), replace(SUN, direction=[0, 0, 1]), MATTE)
    direct, bounced = received(scene, 0), received(scene, 1)
    gained = (bounced - direct)[:, : lower.count].mean(axis=1)
    exact = 0.1998 * np.asarray(MATTE.total_reflectance()) * direct[:, lower.count :].mean(axis=1)
    np.testing.assert_allclose(gained, exact, rtol=0.07)  # rims end half a spacing late
    assert np.max(np.abs(bounced - direct)[:, lower.count :]) < 1e-6


@pytest.mark.once
def test_bounces_are_linear_in_the_lights_and_the_same_at_every_scale():
    body = cup(120)
    of_sun, of_lamp, of_both = (
        received(sj.Scene(body, lights, MATTE), 2) for lights in (SUN, LAMP, (SUN, LAMP))
    )
    np.testing.assert_allclose(of_both, of_sun + of_lamp, rtol=1e-5)
    wide = sj.SumOfGaussians(64 * MATTE.gaussians.variances, MATTE.gaussians.weights)
    large = received(sj.Scene(body.scaled(8.0), SUN, MATTE.surface_of(wide)), 2)
    np.testing.assert_allclose(large, of_sun, rtol=1e-5)


def test_derivatives_in_light_material_and_albedo(float64):
    body = cup(120, 160)
    settings = replace(PLAIN, bounces=2, sightlines=sj.splatting.SightlineSettings(32))
    plan = sj.make_plan(sj.Scene(body, SUN, MATTE), CAMERA, settings)
    factors = np.random.default_rng(3).normal(size=(3, body.count))

    def weighed(strength, weights, variances, albedo, normals):
        material = sj.Material(sj.SumOfGaussians(variances, weights))
        lit = replace(with_albedo(body, albedo), normals=normals)
        scene = sj.Scene(lit, replace(SUN, irradiance=strength), material)
        return jnp.vdot(factors, sj.compute_irradiance(scene, plan, settings).source)

    gaussians, albedo = MATTE.gaussians, jnp.full((body.count, 3), 0.6)
    given = jnp.ones(3), gaussians.weights, gaussians.variances, albedo, body.normals
    check_grads(jax.jit(weighed), given, 1, ["fwd", "rev"], rtol=1e-5)


@pytest.mark.once
def test_a_picture_shows_light_that_was_kept_with_its_bounces():
    body, settings = cup(90), replace(PLAIN, bounces=1, kernel=sj.diffusion.PlainMean())
    scene = sj.Scene(body, SUN, MATTE)
    plan = sj.make_plan(scene, CAMERA, settings)
    frame = sj.render(scene, CAMERA, settings, plan, light=sj.illuminate(scene, plan, settings))
    middle, strength = (slice(6, -6), slice(6, -6)), np.asarray([1.0, 2.0, 3.0])
    gained = (np.asarray(frame.irradiance) - strength * np.asarray(frame.normal)[..., 2:])[middle]
    exact = 0.5 * np.asarray(MATTE.total_reflectance()) * strength / 2
    np.testing.assert_allclose(np.mean(gained, axis=(0, 1)), exact, rtol=0.07)


BALL = sj.Scene(sphere(64), SUN, MATTE)
ONCE = replace(PLAIN, bounces=1)
REFUSED = {
    "negative": (lambda: sj.RenderSettings(bounces=-1), "bounces .*-1"),
    "odd": (lambda: sj.splatting.SightlineSettings(63), "directions .*even.*63"),
    "at pixels": (lambda: replace(ONCE, lighting=LightAtPixels()), "bounces is 1.*LightAtPixels"),
    "plan": (
        lambda: sj.render(BALL, CAMERA, ONCE, sj.make_plan(BALL, CAMERA, PLAIN)),
        "settings.bounces is 1, and the plan was made with 0",
    ),
    "basis": (lambda: sj.diffusion_basis(BALL, CAMERA, ONCE), "settings.bounces is 1.*weights"),
    "Jacobian": (lambda: sj.picture_jacobian(BALL, CAMERA, ONCE), "settings.bounces is 1.*weights"),
    "stream": (
        lambda: sj.render_streamed(
            lambda: [BALL.splats], BALL.lights, MATTE, CAMERA, sj.RenderSettings(bounces=1)
        ),
        "settings.bounces is 1.*stream",
    ),
}


@pytest.mark.once
@pytest.mark.parametrize(("call", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_bounce_is_refused_by_name(call, message):
    assert_refused(call, message)
