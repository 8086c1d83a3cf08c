"""A sum of Gaussians in the terms of others, against their definitions and published numbers."""

import json

import jax.numpy as jnp
import numpy as np

import splatjax as sj


def test_burley_distance_matches_the_mean_distance(float64):
    gaussians = sj.load_material("marble").gaussians
    d = sj.exports.burley_distance(gaussians)
    burley = sj.scattering.Burley(
        jnp.ones(3),
        d * sj.scattering.diffuse_scaling(jnp.ones(3)),
        sj.scattering.diffuse_scaling,
    )
    np.testing.assert_allclose(burley.length_scale(), d, rtol=1e-12)
    r = np.linspace(1e-4, 80, 400_000)
    for profile in (gaussians.white(), burley):
        values = np.asarray(profile(jnp.asarray(r)))
        mean = np.trapezoid(2 * np.pi * (r * r)[:, None] * values, r, axis=0)
        np.testing.assert_allclose(mean, 2.5 * np.asarray(d), rtol=2e-3)


def test_lengths_scale_and_stay_related(dtype):
    gaussians = sj.load_material("skin1").gaussians
    larger = sj.SumOfGaussians(gaussians.variances * 4, gaussians.weights)
    np.testing.assert_allclose(
        sj.exports.burley_distance(larger), 2 * sj.exports.burley_distance(gaussians), rtol=1e-6
    )
    np.testing.assert_allclose(
        sj.exports.blender_radius(larger), 2 * sj.exports.blender_radius(gaussians), rtol=1e-6
    )
    unity = np.asarray(sj.exports.data_sheet(gaussians)["unity"]["shape_parameter"])
    np.testing.assert_allclose(unity * sj.exports.burley_distance(gaussians), 1, rtol=1e-6)
    # As Cycles reads it: a quarter of the radius over pi is the mean free path.
    path = 0.25 * sj.exports.blender_radius(gaussians) / np.pi
    burley = sj.scattering.Burley(
        gaussians.total_reflectance(), path, sj.scattering.diffuse_scaling
    )
    np.testing.assert_allclose(
        burley.length_scale(), sj.exports.burley_distance(gaussians), rtol=1e-5
    )


def test_separable_kernel_is_the_published_one(float64):
    """Red weights of the kernel of 25 samples in SeparableSSS.h: made with strength 0.48, and with
    distances over 1.001, of skin without its narrowest Gaussian.
    """
    published = {
        0.0: 0.530605,
        3.0: 0.000973794,
        2.52083: 0.00333804,
        1.02083: 0.0128496,
        0.1875: 0.0493588,
        0.0208333: 0.0211412,
    }
    variances = np.asarray([0.0484, 0.187, 0.567, 1.99, 7.41])
    narrowed = sj.SumOfGaussians(variances * 1.001**2, [0.100, 0.118, 0.113, 0.358, 0.078])
    offsets, weights = (np.asarray(each) for each in sj.exports.separable_kernel(narrowed, 25, 3.0))
    for offset, weight in published.items():
        at = int(np.argmin(np.abs(offsets - offset)))
        np.testing.assert_allclose(offsets[at], offset, atol=1e-5)
        np.testing.assert_allclose(
            0.48 * weights[at, 0] + (0.52 if offset == 0 else 0), weight, rtol=1e-4
        )


def test_separable_kernel_of_one_gaussian_is_its_blur(float64):
    offsets, weights = sj.exports.separable_kernel(
        sj.SumOfGaussians(jnp.asarray([2.0]), jnp.asarray([[0.3]])), 201, 9.0
    )
    np.testing.assert_allclose(jnp.sum(weights), 1, rtol=1e-12)
    np.testing.assert_allclose(jnp.sum(weights[:, 0] * offsets**2), 2.0, rtol=1e-3)
    np.testing.assert_allclose(offsets, -offsets[::-1], atol=1e-12)


def test_the_sheet_is_json_with_formulas_and_sources(dtype):
    gaussians = sj.load_material("skin").gaussians
    sheet = json.loads(json.dumps(sj.exports.data_sheet(gaussians)))
    assert set(sheet) == {"gaussians", "gpu_gems", "separable_kernel", "burley", "unity", "blender"}
    for entry in sheet.values():
        assert {"formula", "unit", "source"} < set(entry)
    np.testing.assert_array_equal(
        np.asarray(sheet["gaussians"]["weights"], dtype), np.asarray(gaussians.weights)
    )
    np.testing.assert_allclose(np.sum(sheet["gpu_gems"]["weights"], axis=0), 1, rtol=1e-6)
