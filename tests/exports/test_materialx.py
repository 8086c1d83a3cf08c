"""OpenPBR in MaterialX, as MaterialX's own library reads it, and back to the coefficients."""

import MaterialX
import numpy as np
import pytest

import splatjax as sj
from splatjax.io import save_materialx
from splatjax.scattering import HalfSpace, Medium

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


def test_the_coefficients_come_back(tmp_path, float64):
    """Absorbing, nearly white, and in between; lengths in another unit."""
    medium = Medium([2.0, 0.01, 1e-4], [0.5, 1.0, 2.0], 1.4)
    material = sj.Material(sj.SumOfGaussians([1.0], [[0.5] * 3]), 1.4, 0.5, 0.25, medium=medium)
    save_materialx(tmp_path / "it.mtlx", material, mm_per_unit=10.0)
    found = read(tmp_path / "it.mtlx")
    path = 10 * found["subsurface_radius"] * found["subsurface_radius_scale"]
    given = found["subsurface_color"], path, found["specular_ior"]
    back = HalfSpace.of_color(*given, g=found["subsurface_scatter_anisotropy"]).medium
    np.testing.assert_allclose(back.sigma_a, medium.sigma_a, rtol=BACK)
    np.testing.assert_allclose(back.sigma_s_prime, medium.sigma_s_prime, rtol=BACK)
    np.testing.assert_allclose(found["specular_weight"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(found["specular_roughness"], 0.5, rtol=1e-6)


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
    with pytest.raises(ValueError, match=r"it.mtlx: .* 2 channels"):
        save_materialx(tmp_path / "it.mtlx", sj.Material(sj.SumOfGaussians([1.0], [[0.5] * 2])))
    assert not list(tmp_path.iterdir())
