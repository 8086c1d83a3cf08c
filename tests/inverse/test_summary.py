"""What a recovery reports: principal axes of a covariance, and their summary."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from bodies import assert_close, assert_refused

import splatjax as sj


def recovery(
    information, chi_squared=1.0, noise_is_known=True, unresolved=0.0, width=None
) -> sj.inverse.Recovery:
    """Make a recovery of which nothing else is known; `width` is the information about the width
    below which layers are unresolved.
    """
    width = np.zeros(len(information) + 1) if width is None else width
    information = np.block([[information, width[:-1, None]], [width[None]]])
    return sj.inverse.Recovery(
        medium=sj.Medium(0.02, 1.5, 1.3),
        material=sj.Material(sj.SumOfGaussians([1], [[0.5]])),
        intensities=jnp.ones((1, 1)),
        information=jnp.asarray(information, float),
        unresolved=jnp.full(1, unresolved),
        chi_squared=jnp.asarray(chi_squared),
        pictures=(),
        residuals=(),
        ends=(),
        costs=jnp.zeros(1),
        result=optx.RESULTS.successful,
        noise_is_known=noise_is_known,
        relative_noise=0.01,
        steps=1,
        rounds=1,
    )


def along(best: float, worst: float, angle: float) -> np.ndarray:
    """Information of a medium whose best known combination lies at an angle to the axis of
    sigma_a.
    """
    axes = np.asarray([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return axes @ np.diag([best**-2, worst**-2]) @ axes.T


def test_what_is_not_fixed_is_reported():
    """The reduced albedo is known to 1%, the mean free path to 50%."""
    found = recovery(along(0.01, 0.5, -np.pi / 4))
    ((best, worst),) = found.combinations()
    np.testing.assert_allclose([best.deviation, worst.deviation], [0.01, 0.5], rtol=1e-4)
    np.testing.assert_allclose([best.powers, worst.powers], [(1, -1), (1, 1)], rtol=1e-3)
    expected = "sigma_a sigma_s', known to 50%; they fix sigma_a / sigma_s' to 1%"
    assert f"not fixed by these pictures: {expected}" in found.summary(["red"])
    np.testing.assert_allclose(
        found.relative_errors(), np.full((2, 1), np.sqrt((0.01**2 + 0.5**2) / 2)), rtol=1e-4
    )


@pytest.mark.parametrize(
    ("information", "more", "present", "absent"),
    [
        (along(0.01, 1.5, -np.pi / 4), {"unresolved": 0.998}, "known to 150%", "anything"),
        (along(0.01, 1.5, -np.pi / 4), {"unresolved": 0.998}, "+- 110%", "anything"),
        (along(0.01, 0.02, 0.3), {"unresolved": 0.97}, "97% of its light", "not fixed"),
        (along(0.01, 0.02, 0.3), {"unresolved": 0.5}, "+-", "splats"),
        (along(0.01, 0.02, 0.3), {"chi_squared": 9.0}, "3 times the noise", "not fixed"),
        (along(0.01, 0.02, 0.3), {"noise_is_known": False}, "the residuals", "times"),
        (np.zeros((2, 2)), {}, "anything", "nan"),
        (np.full((2, 2), np.nan), {}, "anything", "nan"),
        (np.diag([4.0, 0.0]), {}, "anything", "nan"),
    ],
)
def test_a_summary_reports_what_matters(information, more, present, absent):
    found = recovery(information, **more)
    assert present in found.summary()
    assert absent not in found.summary()
    assert np.all(np.isfinite(found.relative_errors())) == ("anything" not in found.summary())


# The mean free path changes the picture as the width does, the other way round.
OWN, PATH = along(1e-3, 1e-2, -np.pi / 4), np.asarray([1, 1]) / np.sqrt(2)
WEIGHS = PATH @ OWN @ PATH
WIDTH = np.append(-WEIGHS * PATH, WEIGHS)


def test_what_only_the_width_shows_is_known_no_better_than_the_width():
    """The mean free path and the width are known together."""
    found = recovery(OWN, width=WIDTH, unresolved=1.0)
    best, worst = found.combinations()[0]
    np.testing.assert_allclose(best.deviation, 1e-3, rtol=1e-3)
    np.testing.assert_allclose(worst.deviation, np.hypot(0.5 * np.log(2), 1e-2), rtol=1e-3)
    assert "not fixed by these pictures: sigma_a sigma_s', known to 35%" in found.summary()
    np.testing.assert_allclose(found.noise_errors(), recovery(OWN).relative_errors(), rtol=1e-6)
    np.testing.assert_allclose(found.noise_errors(), np.sqrt((1e-6 + 1e-4) / 2), rtol=1e-3)


def test_a_picture_without_unresolved_layers_makes_up_for_one_with_as_far_as_it_weighs():
    """A search weighs pixels by their noise, whatever the width does to them: a weak close
    picture changes little.
    """
    found = recovery(OWN, width=WIDTH)
    for deviation in (1e-1, 1e-2, 1e-3):
        close = np.pad(along(deviation, deviation, 0.0), (0, 1))
        whole = WEIGHS + deviation**-2
        expected = (0.5 * np.log(2) * WEIGHS / whole) ** 2 + 1 / whole
        largest = np.linalg.eigvalsh(found.covariance(close)[0])[-1]
        np.testing.assert_allclose(largest, expected, rtol=1e-4)


def test_an_unknown_intensity_widens_the_bars():
    """Where it does the same as the absorption does, they are infinite."""
    parallel = np.asarray([[4.0, 1.0, 4.0], [1.0, 3.0, 1.0], [4.0, 1.0, 4.0]])
    apart = parallel + np.diag([0, 0, 2.0])
    (at_once,) = recovery(apart).covariance()
    np.testing.assert_allclose(at_once, np.linalg.inv(apart)[:2, :2], rtol=1e-4)
    found = recovery(parallel)
    assert found.combinations()[0][1].deviation > 1e3
    assert "anything" in found.summary()


def test_what_is_combined_is_the_mean_by_what_each_knows():
    """One knows the reduced albedo, the other scattering: together both, whichever comes first."""
    ratio, medium = recovery(along(0.01, 0.5, -np.pi / 4)), sj.Medium(0.03, 1.5, 1.3)
    path = eqx.tree_at(lambda r: r.medium, recovery(np.diag([0.3**-2, 0.02**-2])), medium)
    assert "not fixed" in ratio.summary()

    def point(one):
        return np.log(np.ravel([one.medium.sigma_a, one.medium.sigma_s_prime]))

    first, second = (np.linalg.inv(each.covariance()[0]) for each in (ratio, path))
    expected = np.linalg.solve(first + second, first @ point(ratio) + second @ point(path))
    for given in ([ratio, path], [path, ratio]):
        found = sj.inverse.combined(given)
        np.testing.assert_allclose(point(found), expected, rtol=1e-5)
        np.testing.assert_allclose(found.covariance()[0], np.linalg.inv(first + second), rtol=1e-4)
        assert "not fixed" not in found.summary()


def test_one_alone_stays_what_it_is_and_one_that_knows_nothing_adds_nothing():
    known, nothing = recovery(along(0.01, 0.5, -np.pi / 4)), recovery(np.zeros((2, 2)))
    for given in ([known], [known, nothing], [nothing, nothing]):
        found = sj.inverse.combined(given)
        assert_close(found.medium, given[0].medium, rtol=1e-6)
        np.testing.assert_allclose(found.relative_errors(), given[0].relative_errors(), rtol=1e-4)
        assert found.summary() == given[0].summary()


def test_a_model_that_leaves_much_counts_for_less():
    """Three times the noise widen the bars threefold, and those that are of the residuals already
    not again.
    """
    info = along(0.01, 0.02, 0.3)
    expected = 3 * np.asarray(recovery(info).relative_errors())
    for noise_is_known in (True, False):
        found = recovery(info, chi_squared=9.0, noise_is_known=noise_is_known)
        errors = sj.inverse.combined([found]).relative_errors()
        np.testing.assert_allclose(errors, expected, rtol=1e-5)


def test_what_does_not_belong_together_is_refused():
    one, splats = recovery(along(0.01, 0.02, 0.3)), sj.Splats([[0, 0, 0]], [[0, 0, 1]], 1, 1)
    other = eqx.tree_at(lambda r: r.medium.eta, one, one.medium.eta + 0.1)
    assert_refused(lambda: sj.inverse.combined([one, other]), r"recoveries\[1\].medium.eta is")
    assert_refused(lambda: sj.inverse.next_pictures(one, splats, []), "candidates is empty")
