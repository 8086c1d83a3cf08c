"""The diffusion equation on the body itself: light transport, closed forms, laws, and gradients."""

import dataclasses

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.integrate import quad, solve_bvp
from scipy.optimize import brentq
from scipy.special import eval_legendre, spherical_in

import splatjax as sj
from splatjax.diffusion import Beams, ShapeDiffuser, compact_order

DOWN = np.asarray([0.0, 0.0, -1.0])
RADIUS, SIGMA_T, ALBEDO = 6.0, 1.5, np.asarray([0.999, 0.95])
SPLATS = 600  # 1.3 mean free paths apart
# Mean radiant exitance over the irradiance of the light, in bands of 30 degrees from it, of a
# sphere of that radius without change of index: 8 million walks, 0.3% for the least.
BANDS = np.asarray(
    [
        [0.67009, 0.55643, 0.31563, 0.06125, 0.01993, 0.01392],
        [0.48609, 0.40593, 0.22693, 0.02800, 0.00299, 0.00126],
    ]
)
OF_TRANSPORT = np.asarray([0.006, 0.007, 0.025, 0.055, 0.065, 0.07])
GAUSSIANS = sj.SumOfGaussians([1.0], np.ones((1, 2)))
MERGED, OF_SLOPES = 3e-3, 0.06  # merged sums and their gradients, root mean squares
OF_CLOSED_FORM = 1e-3  # over the brightest, or the irradiance


def medium(albedo=ALBEDO, eta: float = 1.0) -> sj.Medium:
    return sj.Medium(SIGMA_T * (1 - albedo), SIGMA_T * albedo, np.full(len(albedo), eta))


def beams(splats: sj.Splats, direction=DOWN, channels: int = 2) -> Beams:
    """Light of irradiance 1 on a perpendicular surface, all of which enters unbent."""
    direction = jnp.asarray(direction, float)
    irradiance = jnp.maximum(-(splats.normals @ direction), 0)
    directions = jnp.broadcast_to(direction[:, None], (channels, 3, splats.count))
    return Beams(jnp.tile(irradiance, (channels, 1)), directions)


def slab(side: float, depth: float, count: int) -> sj.Splats:
    """Cover a box of side x side x depth; light falls on the face towards +z."""
    box = trimesh.creation.box([side, side, depth])
    vertices, faces = box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3)
    mesh = sj.geometry.Mesh(vertices, faces, np.repeat(box.face_normals, 3, axis=0))
    return sj.geometry.sample_mesh(mesh, count)


exitance_of = eqx.filter_jit(ShapeDiffuser.radiant_exitance)


def solved(
    splats: sj.Splats, medium: sj.Medium, beams: Beams, error: float = 1e-4, opening=0.0, even=0.0
) -> np.ndarray:
    diffuser = ShapeDiffuser(error, opening)
    hierarchy = diffuser.find_hierarchy(splats)
    even = jnp.broadcast_to(jnp.asarray(even, float), (2, splats.count))
    return np.asarray(exitance_of(diffuser, splats, medium, beams, hierarchy, even))


def angles(splats: sj.Splats) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.asarray(splats.normals, float)[:, 2], -1, 1)))


@pytest.fixture(scope="module")
def sphere() -> sj.Splats:
    return bodies.sphere(SPLATS, RADIUS, jitter=0.0)


@pytest.fixture(scope="module")
def exitance(sphere) -> np.ndarray:
    return solved(sphere, medium(), beams(sphere))


@pytest.mark.once
def test_a_sphere_shines_as_in_light_transport(sphere, exitance):
    band = np.minimum((angles(sphere) / 30).astype(int), 5)
    means = np.stack([np.bincount(band, row) / np.bincount(band) for row in exitance])
    off = np.abs(means / BANDS - 1)
    assert np.all(off < OF_TRANSPORT[None]), off
    total = exitance @ np.asarray(sphere.areas) / (np.pi * RADIUS**2)
    assert np.all(np.abs(total / [0.98209, 0.68486] - 1) < [1e-3, 0.0125])


# Of slabs of 2 and 4 mean free paths under perpendicular light, albedo 0.98 and 0.9: what they
# return, and let through scattered; by the integral equation of Milne, 800 layers.
SLABS = {2.0: [[0.4787, 0.3616], [0.3148, 0.2212]], 4.0: [[0.6054, 0.4081], [0.2293, 0.1102]]}


@pytest.mark.once
def test_every_channel_has_light_of_its_own(sphere, exitance):
    from_below = beams(sphere, -DOWN)
    either = jax.tree.map(
        lambda *each: jnp.stack([each[0][0], each[1][1]]), beams(sphere), from_below
    )
    found, below = solved(sphere, medium(), either), solved(sphere, medium(), from_below)
    np.testing.assert_allclose(found, [exitance[0], below[1]], rtol=1e-3)


@pytest.mark.once
@pytest.mark.parametrize("depth", [2.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_a_slab_returns_and_lets_through_what_light_transport_does(depth):
    splats = slab(20, depth, 4000)
    splats = splats.take(jnp.asarray(compact_order(np.asarray(splats.centers))))
    of_slab, opening = sj.Medium([0.02, 0.1], [0.98, 0.9], 1), ShapeDiffuser().opening
    exitance = solved(splats, of_slab, beams(splats), opening=opening)
    is_inner = np.all(np.abs(splats.centers[:, :2]) < 3, axis=1)
    for side, expected in zip((1, -1), SLABS[depth], strict=True):
        mean = exitance[:, is_inner & (side * splats.normals[:, 2] > 0.5)].mean(axis=1)
        np.testing.assert_allclose(mean, expected, rtol=0.025)


@pytest.mark.once
def test_a_sphere_that_absorbs_nothing_loses_what_it_does_not_scatter(sphere):
    exitance = solved(sphere, medium(np.ones(2)), beams(sphere))
    total = exitance @ np.asarray(sphere.areas) / (np.pi * RADIUS**2)
    # Light that crosses 2 R mu unscattered: 2 int exp(-2 R sigma_t mu) mu dmu.
    across = 2 * RADIUS * SIGMA_T
    np.testing.assert_allclose(total, 1 - 2 / across**2, rtol=5e-3)


@pytest.mark.once
def test_even_light_takes_the_way_back_as_well():
    """Reciprocity: as much light of one place leaves at another as the other way around."""
    body = bodies.bumpy(SPLATS, RADIUS)
    dark = dataclasses.replace(beams(body), irradiance=jnp.zeros((2, SPLATS)))
    for pair in ((0, 40), (100, 300), (250, 550)):
        squared = np.sum(np.square(body.centers[None] - body.centers[np.asarray(pair), None]), -1)
        places = np.exp(-squared / 8)
        there, back = (
            solved(body, medium(), dark, 1e-5, even=place) @ (body.areas * other)
            for place, other in (places, places[::-1])
        )
        np.testing.assert_allclose(there, back, rtol=0.02)


@pytest.mark.long
@pytest.mark.once
def test_merged_sums_are_those_of_all_splats_in_value_and_gradient():
    body = bodies.bumpy(SPLATS, RADIUS)
    body = body.take(jnp.asarray(compact_order(np.asarray(body.centers))))
    weights = 1 + body.centers[:, 0]

    def found(opening):
        diffuser = ShapeDiffuser(1e-5, opening)
        hierarchy = diffuser.find_hierarchy(body)

        def loss(given):
            exitance = diffuser.radiant_exitance(*given, hierarchy)
            return jnp.sum(weights[None] * exitance), exitance

        return eqx.filter_jit(jax.grad(loss, has_aux=True))((body, medium(eta=1.3), beams(body)))

    def off(found, expected) -> float:
        """Compute the root mean square of a difference, over that of what is expected."""
        return float(jnp.sqrt(jnp.mean((found - expected) ** 2) / jnp.mean(expected**2)))

    (slopes, of_all), (merged_slopes, merged) = found(0.0), found(ShapeDiffuser().opening)
    assert off(merged, of_all) < MERGED
    used = (0, ("centers", "normals", "areas")), (1, ("sigma_a", "sigma_s_prime", "eta"))
    for argument, names in (*used, (2, ("irradiance",))):
        for name in names:
            ours, theirs = (getattr(each[argument], name) for each in (merged_slopes, slopes))
            assert off(ours, theirs) < OF_SLOPES, name


@pytest.mark.once
def test_the_size_of_body_and_coefficients_does_not_matter(sphere, exitance):
    larger, usual = sphere.scaled(1e4), medium()
    thinner = sj.Medium(usual.sigma_a / 1e4, usual.sigma_s_prime / 1e4, usual.eta)
    found = solved(larger, thinner, beams(larger))
    np.testing.assert_allclose(found, exitance, atol=2e-4 * exitance.max())


def constants(albedo: float):
    """Return the extrapolation distance in mean free paths, the root of the absorption, the
    fraction of light that leaves early from a depth, and Case's discrete eigenvalue.
    """
    z_e, lost = 0.710446 / albedo, np.sqrt(1 - albedo)

    def early(tau):
        hopf = 0.08948 * np.exp(-2.11533 * tau) + 0.04361 * np.exp(-16.63774 * tau)
        held = np.polyval([25.38, -24.39, 13.76, 0, 1], lost)
        return held * hopf / (tau + z_e)

    return z_e, lost, early, brentq(lambda k: albedo * np.arctanh(k) - k, lost, 1 - 1e-9)


def diffused_on_sphere(albedo: float, angle: np.ndarray) -> np.ndarray:
    """Solve for the same sources by a series in Legendre polynomials."""
    z_e, lost, early, unit_kappa = constants(albedo)

    def leaving(way, cosine):
        """Light of one beam that leaves at its entry, and there or at its exit."""
        length = 2 * RADIUS * cosine
        bend = np.clip(1 - 2 * cosine**2, 0, 1)  # the normals at both ends, multiplied
        at_entry = early(SIGMA_T * way * cosine * (1 - bend * way / length))
        return at_entry, at_entry + (1 - bend) * early(SIGMA_T * (length - way) * cosine)

    x, of_x = np.polynomial.legendre.leggauss(200)
    u = (1 - x) / 2
    r, of_r = RADIUS * (1 - u * u), of_x * RADIUS * u
    mu, of_mu = np.polynomial.legendre.leggauss(600)
    entry = np.sqrt(RADIUS**2 - r[:, None] ** 2 * (1 - mu**2))  # R mu_0
    way = entry - r[:, None] * mu
    source = SIGMA_T * albedo * np.exp(-SIGMA_T * way)
    source = source * (1 - leaving(way, entry / RADIUS)[1])
    source = source * (1 - lost**2 * (0.53 + 0.265 * lost**2))
    kappa = SIGMA_T * unit_kappa
    exitance = np.zeros_like(angle)
    for degree in range(60):
        moment = (source * eval_legendre(degree, mu) * of_mu).sum(1) * (2 * degree + 1) / 2
        inside = np.sum(of_r * r * r * moment * spherical_in(degree, kappa * r)) / RADIUS**2
        rim = spherical_in(degree, kappa * RADIUS)
        slope = kappa * spherical_in(degree, kappa * RADIUS, derivative=True)
        exitance += inside / (z_e / SIGMA_T * slope + rim) * eval_legendre(degree, np.cos(angle))
    # What leaves at once.
    cosine = np.maximum(np.cos(angle), 0)[:, None]
    t = RADIUS * cosine * (x + 1)
    at_once = SIGMA_T * albedo * np.exp(-SIGMA_T * t)
    at_once = at_once * leaving(t, np.maximum(cosine, 1e-9))[0]
    return exitance + (at_once * of_x * RADIUS * cosine**2).sum(1)


@pytest.mark.long
def test_the_solution_on_a_sphere_converges_to_the_series():
    errors = []
    for count in (500, 2000, 8000):
        splats = bodies.sphere(count, RADIUS, jitter=0.0)
        exitance = solved(splats, medium(), beams(splats), 1e-6)
        series = np.stack([diffused_on_sphere(a, np.radians(angles(splats))) for a in ALBEDO])
        is_even = np.abs(angles(splats) - 45) < 25  # away from the points' poles and the terminator
        errors.append(np.abs(exitance - series)[:, is_even].max() / series.max())
    assert errors[2] < OF_CLOSED_FORM
    assert errors[2] < errors[1] / 2 < errors[0] / 4


def diffused_in_slab(depth: float, albedo: float) -> np.ndarray:
    """Solve for the same sources between two planes, a mean free path of 1 mm: reflectance and
    transmittance.
    """
    z_e, lost, early, kappa = constants(albedo)
    diffusion = (1 - albedo) / kappa**2

    def equation(z, state):
        source = albedo * np.exp(-z) * (1 - early(z) - early(depth - z))
        source = source * (1 - lost**2 * (0.53 + 0.265 * lost**2))
        return np.stack([state[1], kappa**2 * state[0] - source / diffusion])

    def surfaces(near, far):
        return np.stack([near[0] - z_e * near[1], far[0] + z_e * far[1]])

    z = np.linspace(0, depth, 400)
    fluence = solve_bvp(equation, surfaces, z, np.ones((2, 400)), tol=1e-8, max_nodes=100_000).y[0]
    at_once = [
        quad(lambda z, begin=begin: early(abs(z - begin)) * albedo * np.exp(-z), 0, depth)[0]
        for begin in (0, depth)
    ]
    return diffusion / z_e * fluence[[0, -1]] + at_once


@pytest.mark.long
def test_the_solution_between_planes_is_the_closed_form():
    albedo = np.asarray([0.98, 0.9])
    expected = np.stack([diffused_in_slab(4.0, a) for a in albedo], axis=1)
    splats = slab(24, 4, 5000)
    exitance = solved(splats, sj.Medium(1 - albedo, albedo, 1), beams(splats), 1e-6)
    is_inner = np.all(np.abs(splats.centers[:, :2]) < 1.5, axis=1)
    sides = (is_inner & (side * splats.normals[:, 2] > 0.5) for side in (1, -1))
    found = [exitance[:, side].mean(axis=1) for side in sides]
    np.testing.assert_allclose(found, expected, atol=OF_CLOSED_FORM)


@pytest.mark.once
def test_a_white_body_returns_even_light(sphere):
    none = jax.tree.map(jnp.zeros_like, beams(sphere))
    white, dark = solved(sphere, medium(np.asarray([1.0, 0.95]), 1.4), none, even=1.0)
    np.testing.assert_allclose(white, 1, atol=2e-3)
    assert np.all(dark < 1)
    assert np.ptp(dark) < 0.01


@pytest.mark.once
def test_refused_bodies_and_materials(sphere):
    half = jax.tree.map(lambda leaf: leaf[: SPLATS // 2], sphere)
    turned = dataclasses.replace(sphere, normals=-sphere.normals)
    for body, remedy in ((half, "close the mesh"), (turned, "turn them around")):
        bodies.assert_refused(lambda b=body: ShapeDiffuser().find_hierarchy(b), remedy)


# The Milne problem, by Chandrasekhar's H function for this albedo: radiance of light from deep in a
# half space, `H(mu) / (1 - kappa mu)`, over that at the last cosine.
COSINES, MILNE = (0.95, 0.75, 0.45, 0.25, 0.55), [1.3449, 1.1728, 0.9128, 0.7346, 1.0]


@pytest.mark.long
@pytest.mark.once
def test_light_from_deep_inside_leaves_towards_the_eye_as_in_the_milne_problem():
    of_slab = sj.Medium([0.002] * 2, [0.998] * 2, 1)
    material = sj.Material(GAUSSIANS, eta=1.0, specular=0.0, medium=of_slab)
    light = sj.DirectionalLight(-DOWN, [1.0, 1.0], cast_shadows=False)
    scene = sj.Scene(slab(40, 8, 10_000), [light], material)
    settings = dataclasses.replace(bodies.PLAIN, diffuser=ShapeDiffuser())
    plan, seen, middle = None, [], np.asarray([0.0, 0.0, 4.0])
    for cosine in COSINES:
        away = 200 * np.asarray([np.sqrt(1 - cosine**2), 0, cosine])
        camera = sj.Camera.look_at(middle + away, middle, fov=0.5, width=8, height=8)
        plan = plan or sj.make_plan(scene, camera, settings)
        seen.append(np.asarray(sj.render(scene, camera, settings, plan).diffuse).mean())
    np.testing.assert_allclose(np.asarray(seen) / seen[-1], MILNE, rtol=0.015)


@pytest.mark.long
@pytest.mark.once
def test_pictures_show_the_solved_light():
    of_body = medium(np.asarray([0.998, 0.9]))
    material = sj.Material(GAUSSIANS, eta=1.0, specular=0.0, medium=of_body)
    light = sj.DirectionalLight(DOWN, [1.0, 1.0], cast_shadows=False)
    scene = sj.Scene(bodies.sphere(200, RADIUS, jitter=0.0), [light], material)
    settings = dataclasses.replace(bodies.PLAIN, diffuser=ShapeDiffuser())
    camera = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=3, width=8, height=8)
    given = camera, settings, sj.make_plan(scene, camera, settings)
    frame = sj.render(scene, *given)
    # What light transport sees of the lit pole.
    middle = np.pi * np.asarray(frame.diffuse).mean((0, 1))
    np.testing.assert_allclose(middle, [0.6969, 0.3721], rtol=0.06)
    np.testing.assert_array_equal(frame.layers[0], frame.diffuse)
    other = dataclasses.replace(scene, material=sj.Material(GAUSSIANS))
    bodies.assert_refused(lambda: sj.render(other, *given), r"Material\.medium is None")


@pytest.mark.long
def test_derivatives_of_a_picture_are_those_of_differences(float64):
    """In the coefficients, in the index of refraction, and in the place of the eye. What is seen
    without bounces, tests of every float show.
    """
    sphere = bodies.sphere(200, 3.0, jitter=0.0)
    light = sj.DirectionalLight([-0.3, -0.5, -1.0], [1.0, 1.0], cast_shadows=False)
    settings = dataclasses.replace(bodies.PLAIN, diffuser=ShapeDiffuser(1e-11), bounces=1)
    camera = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=7, width=8, height=8)

    def scene(sigma_a, sigma_s, eta):
        of_body = sj.Medium(sigma_a, sigma_s, eta)
        material = sj.Material(GAUSSIANS, eta=eta, specular=0.0, medium=of_body)
        return sj.Scene(sphere, [light], material)

    def mean(eye, *coefficients):
        moved = dataclasses.replace(camera, position=eye)
        return jnp.mean(sj.render(scene(*coefficients), moved, settings, plan).beauty)

    body = jnp.asarray([0.02, 0.15]), jnp.asarray([1.4, 1.2]), jnp.asarray(1.3)
    plan = sj.make_plan(scene(*body), camera, settings)
    # A short step: the Fresnel reflectance is steep near total reflection.
    bodies.assert_gradient(mean, (camera.position, *body), 1e-6, rtol=1e-6)
