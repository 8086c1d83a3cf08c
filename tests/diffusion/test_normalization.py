"""How light is shared where a body is thin: the laws of the normalization, and sheets against Monte
Carlo.
"""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion import (
    DenseDiffuser,
    ExitOdds,
    Kernels,
    PlainMean,
    SeenSurface,
    Sources,
    diffusion_layers,
)
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import Medium, SingleScattering
from splatjax.scene import Material
from splatjax.splatting import Atlas

# Six Gaussians on the reflectance of half spaces of sigma_t = 1/mm, isotropic scattering, no change
# of index; albedo 0.9, 0.98 and 0.998. `fit_gaussians` on four million walks, non-negative, totals
# held.
VARIANCES = [0.01265, 0.0577, 0.2458, 1.1161, 5.3668, 36.784]
WEIGHTS = [
    [0.02739, 0.03848, 0.08084],
    [0.05131, 0.05521, 0.05484],
    [0.08196, 0.09944, 0.10425],
    [0.12977, 0.16921, 0.17898],
    [0.08900, 0.20930, 0.25600],
    [0.03544, 0.09939, 0.20445],
]
# What a sheet of so many mm lets through of light from straight above, that which never met it left
# out: 400,000 walks.
THROUGH = {
    2.0: [0.2198, 0.3138, 0.3433],
    4.0: [0.1096, 0.2290, 0.2828],
    8.0: [0.0156, 0.0880, 0.1627],
}


def material(weights=WEIGHTS):
    return Material(SumOfGaussians(jnp.asarray(VARIANCES), jnp.asarray(weights)))


def gains(exits, material, albedo=1.0, normalization=None):
    """Of a point with exits [gaussians]: [gaussians, channels]."""
    return _gains(
        jnp.asarray(exits),
        material,
        jnp.asarray(albedo),
        ExitOdds() if normalization is None else normalization,
    )


@eqx.filter_jit
def _gains(exits, material, albedo, normalization):
    gaussians = material.gaussians
    exits = jnp.broadcast_to(exits, gaussians.variances.shape)[:, None]
    once = (material.total_reflectance() - gaussians.total_reflectance()) * albedo
    return normalization.gain(exits, gaussians.variances, gaussians.weights * albedo, once)


def gain(exits, material, albedo=1.0):
    return np.asarray(gains(exits, material, albedo))


@pytest.mark.parametrize("exits", [0.0, 0.4, 1.0])
def test_flat_pieces_and_open_edges_keep_their_mean(exits):
    np.testing.assert_array_equal(gain(exits, material()), 1)


def test_what_absorbs_nothing_returns_all_whatever_the_shape():
    white = material().white()
    for exits in (3.0, np.linspace(1.1, 2.5, 6)):
        np.testing.assert_allclose(
            np.sum(np.asarray(white.gaussians.weights) * gain(exits, white), axis=0), 1, rtol=1e-5
        )
    np.testing.assert_array_equal(np.asarray(gains(3.0, material(), normalization=PlainMean())), 1)


def test_odds_of_leaving_grow_as_the_exits():
    """For one Gaussian that is all there is: far above the rounded corner."""
    one = Material(SumOfGaussians(jnp.asarray([1.0]), jnp.asarray([[0.3, 0.8]])))
    for exits in (40.0, 200.0):
        leaving = np.asarray([0.3, 0.8]) * gain(exits, one)[0]
        odds = leaving / (1 - leaving)
        np.testing.assert_allclose(odds, exits * np.asarray([3 / 7, 4.0]), rtol=0.05)
    darker = Material(SumOfGaussians(one.gaussians.variances, 0.5 * one.gaussians.weights))
    np.testing.assert_allclose(gain(2.0, one, albedo=0.5), gain(2.0, darker), rtol=1e-6)


def test_nothing_returns_more_than_it_receives():
    rng = np.random.default_rng(4)
    for _ in range(20):
        weights = rng.exponential(size=(6, 2))
        weights *= rng.uniform(0.1, 1, size=2) / weights.sum(0)
        factors = gain(1 + 3 * rng.exponential(size=6), material(weights))
        assert np.all(np.sum(weights * factors, axis=0) <= 1 + 1e-5)


def test_more_exits_let_out_more_and_leave_less_for_wider_layers():
    weights = np.asarray(WEIGHTS)
    out = [np.sum(weights * gain(exits, material()), axis=0) for exits in (1.0, 1.5, 2.0)]
    assert np.all(np.diff(out, axis=0) > 0.02)
    narrow_too = gain(np.asarray([2.0] * 6), material())
    wide_alone = gain(np.asarray([1.0] * 3 + [2.0] * 3), material())
    assert np.all(narrow_too[3:] < wide_alone[3:])
    assert np.all(gain(2.0, material(), albedo=0.5) > gain(2.0, material())), (
        "the darker gains more of what it would lose"
    )


def test_layers_need_no_order():
    turned = Material(SumOfGaussians(jnp.asarray(VARIANCES)[::-1], jnp.asarray(WEIGHTS)[::-1]))
    exits = np.linspace(1.1, 2.5, 6)
    np.testing.assert_allclose(gain(exits[::-1], turned)[::-1], gain(exits, material()), rtol=1e-6)


def test_what_scattered_once_is_not_absorbed():
    """With single scattering as a term of its own and the rest in the Gaussians, nothing absorbed
    still returns all.
    """
    single = SingleScattering(Medium(jnp.zeros(1), jnp.ones(1), jnp.full(1, 1.4)))
    rest = 1 - float(single.total_reflectance()[0])
    gaussians = SumOfGaussians(jnp.asarray([1.0, 4.0]), jnp.asarray([[0.4 * rest], [0.6 * rest]]))
    found = gain(2.5, Material(gaussians, single_scattering=single))
    np.testing.assert_allclose(
        np.sum(np.asarray(gaussians.weights) * found, axis=0), rest, rtol=1e-5
    )
    assert np.all(
        np.sum(np.asarray(gaussians.weights) * gain(2.5, Material(gaussians)), axis=0) > 1.01 * rest
    )


def test_negative_weights_count_as_none():
    """A free fit may have some: what is left is shared as if they were not there."""
    weights = np.asarray([[0.5], [-0.2], [0.3]])
    signed, without = (
        Material(SumOfGaussians(jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray(w)))
        for w in (weights, np.maximum(weights, 0))
    )
    np.testing.assert_allclose(gain(2.0, signed), gain(2.0, without), rtol=1e-6)


def test_slope_in_a_weight_of_zero_is_the_limit_from_above():
    @jax.jit
    def out(w):
        lit = Material(
            SumOfGaussians(jnp.asarray([1.0, 4.0]), jnp.stack([w, jnp.asarray(0.4)])[:, None])
        )
        return jnp.sum(lit.gaussians.weights * gains(2.0, lit))

    step = 2e-3
    w = jnp.asarray(0.0)
    np.testing.assert_allclose(
        float(jax.grad(out)(w)), float(out(w + step) - out(w)) / step, rtol=1e-2
    )


@pytest.mark.parametrize("ends", [(0.1, 0.2), (0.5, 3.0), (1.0, 5.0)])
def test_a_thin_white_sheet_returns_what_it_receives_whatever_is_handed_over(ends):
    """Lit evenly from both sides: layers that are diffused, handed over, and in between."""
    spacing, half = 0.5, 10.0
    x, y = np.meshgrid(np.arange(-half, half + 0.1, spacing), np.arange(-half, half + 0.1, spacing))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    up = np.zeros_like(flat) + np.asarray([[0.0], [0.0], [1.0]])
    centers, normals = (
        np.concatenate([flat, flat - 0.5 * up], axis=1),
        np.concatenate([up, -up], axis=1),
    )
    sources = Sources(
        *map(
            jnp.asarray,
            (centers, normals, np.full(2 * x.size, spacing**2), np.ones((1, 2 * x.size))),
        )
    )
    one = jnp.ones((1, 1))
    seen = SeenSurface(jnp.zeros((1, 3, 1)), one > 0, one[None], spacing**2 * one, one[None])
    gaussians = SumOfGaussians(jnp.asarray([0.3, 1.0, 4.0]), jnp.asarray([[0.3], [0.3], [0.4]]))
    layers, returned = diffused(sources, gaussians, seen, jnp.asarray(ends))
    assert np.any(np.asarray(layers.resolved) > 0)
    np.testing.assert_allclose(float(returned), 1, rtol=1e-4)
    darker = SumOfGaussians(gaussians.variances, 0.5 * gaussians.weights)
    assert 0.5 < float(diffused(sources, darker, seen, jnp.asarray(ends))[1]) < 1


@eqx.filter_jit
def diffused(sources, gaussians, seen, ends):
    """The layers at one point, and their weighted sum there."""
    atlas = unused_atlas()
    layers, _ = diffusion_layers(
        sources, Material(gaussians), seen, ends, atlas, DenseDiffuser(), ExitOdds()
    )
    return layers, jnp.sum(gaussians.weights * layers.layers[0, :, :, 0])


def unused_atlas() -> Atlas:
    """Of one pixel; the plain diffuser does not look at it."""
    return Atlas.of(jnp.zeros((2, 1, 1)), bodies.perspective(width=1, height=1), 1)


def test_the_corner_is_rounded():
    slope = jax.jit(jax.grad(lambda s: jnp.sum(gains(s, material()) * jnp.ones((6, 3)))))
    assert float(slope(jnp.asarray(1.0))) == 0
    assert 0 < float(slope(jnp.asarray(1.001))) < 0.05 * float(slope(jnp.asarray(1.2)))


def test_no_weights_at_all_have_finite_gradients():
    almost = np.asarray([0.5, 0.5, 0.0, 0.0, 0.0, np.finfo(np.float32).tiny])[:, None]
    slope = jax.jit(jax.grad(lambda w: jnp.sum(gains(2.0, material(w)))))
    for weights in (np.zeros((6, 1)), np.eye(6)[:, :1], almost):
        assert np.all(np.isfinite(np.asarray(slope(jnp.asarray(weights)))))


def through_a_sheet(thickness: float, normalization) -> np.ndarray:
    """Light enters the far side of a wide sheet of splats; what leaves in the middle of this side,
    per channel.
    """
    half, spacing = 30.0, 0.6
    x, y = np.meshgrid(np.arange(-half, half + 0.1, spacing), np.arange(-half, half + 0.1, spacing))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    up = np.zeros_like(flat) + np.asarray([[0.0], [0.0], [1.0]])
    centers = np.concatenate([flat, flat - thickness * up], axis=1)
    entering = np.repeat([0.0, 1.0], x.size)[None]
    sources = Sources(
        *map(
            jnp.asarray,
            (centers, np.concatenate([up, -up], axis=1), np.full(2 * x.size, spacing**2), entering),
        )
    )
    exits, means = exits_and_means(sources, normalization)
    carried = (
        np.asarray(VARIANCES) > spacing**2
    )  # the others are too narrow for the splats, and do not reach
    exits, means = np.where(carried, exits, 1.0), np.where(carried[:, None], means, 0.0)
    layers = np.asarray(gains(exits, material(), normalization=normalization)) * means
    return np.sum(np.asarray(WEIGHTS) * layers, axis=0)


@eqx.filter_jit
def exits_and_means(sources, normalization):
    """Of every layer at the origin."""
    kernels = Kernels.of(jnp.asarray(VARIANCES), normalization)
    points, covered = jnp.zeros((1, 3, 1)), jnp.ones((1, 1), bool)
    found = DenseDiffuser().diffuse(sources, kernels, points, covered, unused_atlas())
    return found.exits[0, :, 0], found.means[0, :, :, 0]


@pytest.mark.parametrize("thickness", list(THROUGH))
def test_sheets_let_through_what_walks_say(thickness):
    """Far better than the mean over the splats as they lie, which loses from a third to three
    quarters of it.
    """
    truth = np.asarray(THROUGH[thickness])
    ours = through_a_sheet(thickness, ExitOdds()) / truth - 1
    plain = through_a_sheet(thickness, PlainMean()) / truth - 1
    where = truth > 0.05
    assert np.all(np.abs(ours[where]) < 0.35), ours
    assert np.all(np.abs(ours[where]) < 0.6 * np.abs(plain[where])), (ours, plain)
