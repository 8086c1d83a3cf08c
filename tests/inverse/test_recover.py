"""Coefficients put in come back: from afar, with noise, and with lights whose strength is not
known.
"""

from functools import cache, partial
from unittest import mock

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from bodies import assert_refused, lights_from_two_sides as lights

import splatjax as sj
from splatjax.inverse._observation import Evidence
from splatjax.inverse._problem import RecoveryProblem, Unknowns, solution

# Nearly all layers are resolved: pictures are made as they are searched, however coarse the splats.
PLAIN = sj.RenderSettings(
    rasterizer=sj.splatting.DenseRasterizer(),
    diffuser=sj.diffusion.DenseDiffuser(),
    kernel=sj.diffusion.EscapeNormalization(regular=(0.1, 0.2), scattered=(0.1, 0.2)),
)
SIZE = 24
camera = partial(bodies.view, size=SIZE)
COUNT = 3
DIPOLE = sj.fitting.DiffusionModel()
HELD = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
# The second light, than is given.
STRONGER = 1.7
NOISE = 0.01
# Rounds end when one moves nothing by more than 1e-3; 2e-4 measured.
ROUNDS = 5e-4


def medium(times_a=1.0, times_s=1.0) -> sj.Medium:
    return sj.Medium(np.array([0.01, 0.05]) * times_a, np.array([0.4, 0.7]) * times_s, eta=1.3)


STARTS = [(3, 1 / 3), (1 / 3, 3)]


@cache
def taken():
    splats = bodies.bumpy(200)
    gaussians = sj.fit_gaussians(sj.Dipole(medium()), COUNT, weights=HELD).gaussians
    scenes = [
        sj.Scene(splats, (light,), sj.Material(gaussians, eta=1.3, specular=0.0))
        for light in lights()
    ]
    pictures = [
        sj.diffusion_basis(scene, camera(), PLAIN, derivative=True).beauty(gaussians)
        for scene in scenes
    ]
    return splats, [
        np.asarray(picture) * factor
        for picture, factor in zip(pictures, (1.0, STRONGER), strict=True)
    ]


def observations(pictures, deviation=None):
    intensities = sj.inverse.KnownIntensity(), sj.inverse.UnknownIntensity()
    return [
        sj.inverse.Observation(picture, camera(), light, deviation=deviation, intensity=intensity)
        for picture, light, intensity in zip(pictures, lights(), intensities, strict=True)
    ]


def recovered(pictures, starts, deviation=None, **more) -> sj.inverse.Recovery:
    media = [
        jax.tree.map(lambda leaf: leaf.astype(jnp.float32), medium(*off)) for off in starts
    ]  # as they are loaded elsewhere
    return sj.inverse.recover(
        observations(pictures, deviation),
        taken()[0],
        media,
        count=COUNT,
        settings=PLAIN,
        **({"model": DIPOLE} | more),
    )


def errors(found: sj.inverse.Recovery) -> np.ndarray:
    truth = medium()
    return np.stack(
        [
            np.log(np.asarray(found.medium.sigma_a) / np.asarray(truth.sigma_a)),
            np.log(np.asarray(found.medium.sigma_s_prime) / np.asarray(truth.sigma_s_prime)),
        ]
    )


@cache
def without_noise() -> sj.inverse.Recovery:
    return recovered(taken()[1], STARTS)


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.usefixtures("double")
class TestRecover:
    @pytest.mark.long
    def test_another_loss_finds_them_too(self):
        found = recovered(taken()[1], STARTS[:1], loss=sj.inverse.HuberLoss())
        assert np.max(np.abs(errors(found))) < ROUNDS

    def test_it_finds_the_coefficients_from_starts_a_factor_of_three_off(self):
        found = without_noise()
        assert np.max(np.abs(errors(found))) < ROUNDS
        np.testing.assert_allclose(found.intensities, [[1, 1], [STRONGER, STRONGER]], rtol=1e-4)
        first, second = found.ends
        np.testing.assert_allclose(first.sigma_a, second.sigma_a, rtol=1e-2)

    def test_its_material_and_pictures_are_those_of_the_renderer(self):
        found, (splats, pictures) = without_noise(), taken()
        scene = sj.Scene(splats, (lights()[0],), found.material)
        again = np.asarray(
            sj.diffusion_basis(scene, camera(), PLAIN, derivative=True).beauty(
                found.material.gaussians
            )
        )
        counted = np.isfinite(found.pictures[0])
        assert 0.3 < np.mean(counted) < 0.9
        np.testing.assert_allclose(found.pictures[0][counted], again[counted], rtol=1e-6)
        for made, left, seen in zip(found.pictures, found.residuals, pictures, strict=True):
            np.testing.assert_allclose(left, made - seen, atol=1e-12)

    @pytest.mark.long
    def test_pictures_from_three_sides_under_one_light_are_lit_once_a_round(self, monkeypatch):
        illuminate = mock.Mock(wraps=sj.illuminate)
        monkeypatch.setattr("splatjax.inverse._problem.illuminate", illuminate)
        scene = sj.Scene(taken()[0], lights()[0], without_noise().material)
        views = [camera((x, 4.0, 40.0)) for x in (-20.0, 6.0, 20.0)]
        seen = [
            sj.inverse.Observation(sj.render(scene, view, PLAIN).beauty, view, lights()[0])
            for view in views
        ]
        start = medium(*STARTS[0])
        found = sj.inverse.recover(
            seen, taken()[0], start, count=COUNT, settings=PLAIN, model=DIPOLE
        )
        assert np.max(np.abs(errors(found))) < 2 * ROUNDS
        assert illuminate.call_count == 1 + found.rounds

    def test_noise_stays_within_the_error_bars_and_compiles_nothing(self, compiled):
        truth, bars = taken()[1], []
        without_noise()
        rng, deviation = np.random.default_rng(3), 0.01 * np.sqrt(np.mean(truth[0] ** 2))
        pulls = []
        for draw in range(4):
            noisy = [picture + deviation * rng.normal(size=picture.shape) for picture in truth]
            found = recovered(noisy, STARTS, deviation)
            off = errors(found)
            bars.append(np.stack(found.relative_errors()))
            noise = np.stack(found.noise_errors())
            assert np.all(bars[-1] >= noise)
            pulls.append(off / noise)
            assert 0.8 < float(found.chi_squared) < 1.2
            if draw == 0:  # what is left to compile is done; from here on nothing is
                compiled.clear()
        assert compiled == []
        assert np.max(bars) < 0.1
        assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.5
        assert np.mean(np.abs(pulls) < 2) > 0.85

    @pytest.mark.long
    def test_light_transport_comes_back_with_its_angles(self):
        model, splats = sj.fitting.TransportModel(), taken()[0]
        profile = model.profile(medium())
        light = sj.fit_gaussians(profile, COUNT, weights=HELD, rule=model.rule).gaussians
        material = sj.Material(light, eta=1.3, specular=0.0, angles=model.angles(medium()))
        pictures = [
            sj.render(sj.Scene(splats, lamp, material), camera(), PLAIN).beauty * factor
            for lamp, factor in zip(lights(), (1.0, STRONGER), strict=True)
        ]
        found = recovered(pictures, [(1.5, 0.8)], model=model)
        assert np.max(np.abs(errors(found))) < 2 * ROUNDS
        angles = found.material.angles.coefficients
        np.testing.assert_allclose(angles, material.angles.coefficients, atol=1e-3)

    def test_unsettled_it_returns_its_best_round_with_bars(self, monkeypatch):
        monkeypatch.setattr("splatjax.inverse._recover._ROUNDS", 1)
        with pytest.warns(RuntimeWarning, match=r"last round \(1\)"):
            found = recovered(taken()[1], STARTS)
        assert found.result != optx.RESULTS.successful
        assert np.all(np.isfinite(found.relative_errors()))
        assert np.max(np.abs(errors(found))) < 0.1

    @pytest.mark.long
    def test_one_picture_of_unknown_strength_does_not_fix_both_coefficients_and_a_second_one_does(
        self,
    ):
        noise = 5 * NOISE
        (_, alone), splats = observations(taken()[1], noise), taken()[0]
        found = sj.inverse.recover(
            [alone], splats, medium(1.5, 0.7), count=COUNT, settings=PLAIN, model=DIPOLE
        )
        assert "not fixed by these pictures" in found.summary()
        dot = sj.GaussianBeam(
            camera().position, -camera().position, jnp.full(2, 20.0), jnp.asarray(2.0)
        )
        candidates = [
            sj.inverse.Candidate("lamp", camera(), (lights()[0],)),
            sj.inverse.Candidate("dot", camera(), (dot,)),
            sj.inverse.Candidate("color", camera(), (lights()[0],), sj.inverse.UnknownColor()),
        ]
        ranked = sj.inverse.next_pictures(found, splats, candidates, settings=PLAIN)
        left = {one.candidate.name: one.worst.deviation for one in ranked}
        assert list(left.values()) == sorted(left.values())
        now = max(worst.deviation for _, worst in found.combinations())
        assert max(left["lamp"], left["dot"]) < 0.1 < now
        # A lamp of known strength adds more, and no picture adds less than nothing.
        assert left["lamp"] < left["color"] <= now * (1 + 1e-9)
        assert f"{ranked[0].candidate.name}: " in str(ranked[0])
        both = recovered(taken()[1], STARTS[:1], noise)
        assert "not fixed" not in both.summary()
        np.testing.assert_allclose(
            both.medium.sigma_a, medium().sigma_a, rtol=5e-3
        )  # rounds end when one moves less than a tenth of a bar


def half_resolved():
    """A problem without observations, and a point: layers at 40 points, of which the narrower ones
    are unresolved in part.
    """
    rng, points = np.random.default_rng(6), 40
    light = sj.diffusion.LayersAtPoints(
        variances=jnp.asarray([1.5, 2.5, 9.0]),
        means=jnp.asarray(rng.uniform(0.5, 1.0, (3, 2, points))),
        mass=jnp.ones((3, points)),
        irradiance=jnp.asarray(rng.uniform(0.0, 2.0, (2, points))),
        area=jnp.ones(points),
        albedo=jnp.ones((2, points)),
        interval=jnp.asarray([1.0, 2.0]),
        kernel=sj.diffusion.PlainMean(),
        derivative=None,
    )
    picture = sj.DiffusionBasis(
        light=light,
        pixel_radiance_per_exitance=jnp.ones((2, points)),
        pixels=jnp.arange(points),
        in_front=jnp.ones(points),
        specular=jnp.zeros((1, points, 2)),
        coverage=jnp.ones((1, points)),
        overflow=jnp.zeros(()),
    )
    view = sj.Camera.look_at([0, 0, 9], [0, 0, 0], width=points, height=1)
    noise = np.full((1, points, 2), 0.01)
    seen = sj.inverse.Observation(noise, view, lights(), deviation=noise)
    unknowns = Unknowns.of(medium().eta, [sj.inverse.KnownIntensity()])
    fit = eqx.Partial(sj.fitting.fit_weights, variances=light.variances, weights=HELD)
    settings = unknowns, fit, sj.inverse.SquaredLoss(), DIPOLE
    problem = RecoveryProblem.of([picture], [Evidence.of(seen, light.area.dtype)], *settings)
    return problem, unknowns.start(medium())


def wider(problem, by):
    return eqx.tree_at(
        lambda one: one.pictures[0].light.interval,
        problem,
        replace_fn=lambda interval: interval * jnp.exp(by),
    )


@pytest.mark.once
@pytest.mark.usefixtures("double")
def test_each_channel_has_a_width_of_its_own_and_its_light_is_counted():
    """The block between unknowns and widths is how far a wrong width leads a search astray."""
    (problem, point), step = half_resolved(), 1e-5

    @jax.jit
    def residuals(point, by):
        return wider(problem, by).residuals(point)

    ways = [(way, 0.0) for way in step * np.eye(len(point))] + [(0 * point, step)]
    slopes = [
        np.asarray(residuals(point + way, by) - residuals(point - way, -by)) / (2 * step)
        for way, by in ways
    ]
    slopes[-1:] = [slopes[-1] * channel for channel in np.eye(2)[:, None]]
    slopes = np.reshape(slopes, (len(slopes), -1))
    information, unresolved, gaussians, _ = solution(problem, point)
    expected = slopes @ slopes.T
    np.testing.assert_allclose(information, expected, rtol=1e-6, atol=1e-6 * expected.max())
    own = expected[4:, 4:]
    np.testing.assert_allclose(information[4:, 4:], own, rtol=1e-6, atol=1e-6)
    assert np.min(np.diagonal(own)) > 1
    light = problem.pictures[0].light
    resolved = sj.diffusion.resolved_fraction(light.variances, jnp.ones(3), light.interval)
    assert 0.05 < float(resolved[0]) < float(resolved[1]) < 0.6
    expected = (1 - resolved) @ gaussians.weights / gaussians.total_reflectance()
    np.testing.assert_allclose(unresolved, expected, rtol=1e-6)
    assert 0.05 < float(jnp.min(expected)) < float(jnp.max(expected)) < 0.98


def test_the_smooth_loss_bends():
    loss = sj.inverse.HuberLoss(2.0)
    r = jnp.asarray([-1e3, -3.0, 0.0, 1e-3, 3.0])
    np.testing.assert_allclose(
        loss.root(r) ** 2,
        2 * 4 * (np.sqrt(1 + np.asarray(r, float) ** 2 / 4) - 1),
        rtol=1e-3,
        atol=1e-9,
    )
    np.testing.assert_allclose(loss.root(r[3]) / r[3], 1.0, rtol=1e-6)
    assert float(loss.root(r)[0]) < 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observations": []}, "got 0 and 1"),
        ({"starts": [medium(), sj.Medium([0.1, 0.1], 1.0, 1.5)]}, r"starts\[1\]\.eta is \[1\.5"),
        ({"starts": medium(times_a=0.0)}, r"starts\[0\]\.sigma_a must be .* logarithms"),
        ({"channels": 3}, r"observations\[0\]\.picture has 3 channels, starts has 2"),
        (
            {"surface": sj.Material(sj.SumOfGaussians([1], [[1, 1]]), eta=1.5)},
            r"surface\.eta is 1\.5, starts\[0\]\.eta \[1\.(29|3)",
        ),
    ],
)
def test_what_cannot_be_recovered_is_refused(change, message):
    light = sj.DirectionalLight([0, 0, -1], [1, 1], cast_shadows=False)
    picture = np.ones((SIZE, SIZE, change.pop("channels", 2)))
    seen = [sj.inverse.Observation(picture, camera(), light)]
    arguments = {"observations": seen, "splats": bodies.sphere(60), "starts": medium()}
    assert_refused(lambda: sj.inverse.recover(**(arguments | change)), message)
