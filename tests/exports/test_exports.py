"""A sum of Gaussians in the terms of others, against their definitions and published numbers.
OpenPBR in MaterialX, as MaterialX's own library reads it, and back to the coefficients.
"""

import json

import jax.numpy as jnp
import MaterialX
import numpy as np
import pytest
from bodies import assert_close, assert_refused

import splatjax as sj
from splatjax.io import save_materialx
from splatjax.scattering import HalfSpace, Medium


def test_burley_distance_matches_the_mean_distance(float64):
    gaussians = sj.load_material("marble").gaussians
    d = sj.exports.burley_distance(gaussians)
    scaling = sj.scattering.diffuse_scaling
    burley = sj.scattering.Burley(jnp.ones(3), d * scaling(jnp.ones(3)), scaling)
    np.testing.assert_allclose(burley.length_scale(), d, rtol=1e-12)
    r = np.linspace(1e-4, 80, 400_000)
    for profile in (gaussians.white(), burley):
        values = np.asarray(profile(jnp.asarray(r)))
        mean = np.trapezoid(2 * np.pi * (r * r)[:, None] * values, r, axis=0)
        np.testing.assert_allclose(mean, 2.5 * np.asarray(d), rtol=2e-3)


def test_lengths_scale_and_stay_related(dtype):
    gaussians = sj.load_material("skin1").gaussians
    larger = sj.SumOfGaussians(gaussians.variances * 4, gaussians.weights)
    for length in (sj.exports.burley_distance, sj.exports.blender_radius):
        np.testing.assert_allclose(length(larger), 2 * length(gaussians), rtol=1e-6)
    unity = np.asarray(sj.exports.data_sheet(gaussians)["unity"]["shape_parameter"])
    np.testing.assert_allclose(unity * sj.exports.burley_distance(gaussians), 1, rtol=1e-6)
    # As Cycles reads it: a quarter of the radius over pi is the mean free path.
    path = 0.25 * sj.exports.blender_radius(gaussians) / np.pi
    total, scaling = gaussians.total_reflectance(), sj.scattering.diffuse_scaling
    distance = sj.scattering.Burley(total, path, scaling).length_scale()
    np.testing.assert_allclose(distance, sj.exports.burley_distance(gaussians), rtol=1e-5)


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


# Of the coefficients: a color is found again within 1e-4, and the coefficients of one near 1
# depend on it the most.
BACK = 2e-3


def read(path) -> dict[str, np.ndarray]:
    """Read the inputs of the surface of the only material, in a document that is valid."""
    document, library = MaterialX.createDocument(), MaterialX.createDocument()
    search = MaterialX.getDefaultDataSearchPath()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), search, library)
    MaterialX.readFromXmlFile(document, str(path))
    document.setDataLibrary(library)
    is_valid, faults = document.validate()
    assert is_valid, faults
    (material,) = document.getMaterialNodes()
    (surface,) = MaterialX.getShaderNodes(material)
    definition = surface.getNodeDef()
    assert surface.getCategory() == "open_pbr_surface"
    values = {}
    for given in surface.getInputs():
        assert definition.getInput(given.getName()).getType() == given.getType()
        value = given.getValue()
        values[given.getName()] = np.asarray(getattr(value, "asTuple", lambda v=value: v)())
    return values


@pytest.mark.parametrize("g", [0.0, 0.9, -0.5])
def test_the_coefficients_come_back(tmp_path, float64, g):
    """Absorbing, nearly white, and in between; lengths in another unit."""
    medium = Medium([2.0, 0.01, 1e-4], [0.5, 1.0, 2.0], 1.4)
    material = sj.Material(sj.SumOfGaussians([1.0], [[0.5] * 3]), 1.4, 0.5, 0.25, medium=medium)
    save_materialx(tmp_path / "it.mtlx", material, mm_per_unit=10.0, g=g)
    found = read(tmp_path / "it.mtlx")
    path = 10 * found["subsurface_radius"] * found["subsurface_radius_scale"]
    given = found["subsurface_color"], path, found["specular_ior"]
    back = HalfSpace.of_color(*given, g=found["subsurface_scatter_anisotropy"]).medium
    expected = medium.sigma_a, medium.sigma_s_prime
    assert_close((back.sigma_a, back.sigma_s_prime), expected, rtol=BACK)
    np.testing.assert_allclose(found["subsurface_scatter_anisotropy"], g, rtol=1e-6)
    colors = HalfSpace(back, g).color(), HalfSpace(medium, g).color()
    np.testing.assert_allclose(*colors, rtol=1e-3)
    surface = found["specular_weight"], found["specular_roughness"]
    np.testing.assert_allclose(surface, 0.5, rtol=1e-6)


def test_normalized_diffusion_stands_for_gaussians_alone(tmp_path, float64):
    """Its albedo is theirs, and so is its mean distance: 2.5 d, where d is the path over `s(A)`."""
    gaussians = sj.SumOfGaussians([1.0, 9.0], [[0.1, 0.3, 0.5], [0.2, 0.2, 0.4]])
    save_materialx(tmp_path / "it.mtlx", sj.Material(gaussians))
    found = read(tmp_path / "it.mtlx")
    albedo = found["subsurface_color"]
    np.testing.assert_allclose(albedo, [0.3, 0.5, 0.9], rtol=1e-6)
    path = found["subsurface_radius"] * found["subsurface_radius_scale"]
    distance = 2.5 * path / (1.9 - albedo + 3.5 * (albedo - 0.8) ** 2)
    mean = np.sqrt(np.pi / 2 * gaussians.variances) @ gaussians.weights / albedo
    np.testing.assert_allclose(distance, mean, rtol=1e-6)


def test_two_channels_are_refused(tmp_path):
    two = sj.Material(sj.SumOfGaussians([1.0], [[0.5] * 2]))
    assert_refused(lambda: save_materialx(tmp_path / "it.mtlx", two), r"it.mtlx: .* 2 channels")
    assert_refused(lambda: save_materialx(tmp_path / "it.toml", two), r"it.toml: .*\.mtlx")
    assert not list(tmp_path.iterdir())
