"""Where spectra become color: white, illuminants, the skin locus, and pictures of spectra."""

import subprocess
import sys
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import PLAIN, assert_refused, camera_over, sheet, sphere, view
from PIL import Image

import splatjax as sj

WAVELENGTHS = np.arange(400, 701, 10)
# Median lightness of each band of ten, and the 5th and 95th percentile of a* and b* under D65: 5500
# spectra of hands, arms and foreheads in the International Skin Spectra Archive (Lu et al. 2025,
# Scientific Data, doi 10.1038/s41597-025-04857-5).
LIGHTNESS = [28.7, 35.5, 46.9, 56.3, 63.1, 70.7]
LOCUS = {
    "a": ([4.8, 7.3, 7.9, 6.8, 4.5, 3.7], [7.8, 12.3, 13.9, 14.8, 12.9, 7.5]),
    "b": ([4.8, 7.6, 14.9, 14.5, 12.0, 10.0], [8.7, 17.3, 22.1, 22.5, 20.5, 15.8]),
}
NEAR = 0.1  # the eye sees a difference of one or two
SURFACE = (0.5 / 2.5) ** 2  # what an index of 1.5 reflects along the normal
SIX = [0.02, 0.04, 0.07, 0.11, 0.17, 0.26]  # melanin from light to dark


def tristimulus(reflectance, illuminant):
    """Compute X, Y and Z of a surface, Y 1 for a white one, by colour-science."""
    import colour

    shape = colour.SpectralShape(380, 780, 1)
    fine = np.interp(shape.wavelengths, WAVELENGTHS, reflectance)
    light, observer = (
        table.copy().align(shape)
        for table in (
            colour.SDS_ILLUMINANTS[illuminant],
            colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"],
        )
    )
    patch = colour.SpectralDistribution(fine, shape)
    return colour.sd_to_XYZ(patch, observer, light, method="Integration") / 100


@pytest.mark.parametrize("illuminant", ["D65", "A", "FL11", "Philips TL-84"])
def test_white_is_white_and_red_is_red(illuminant):
    matrix = sj.io.spectrum_to_rgb(WAVELENGTHS, illuminant)
    np.testing.assert_allclose(np.full(31, 0.3) @ matrix, 0.3, rtol=1e-12)
    red = (WAVELENGTHS > 600) @ matrix
    assert red[0] > 0.6 > 0.2 > red[1]


def test_colors_are_those_of_colour_science():
    import colour

    shape = colour.SpectralShape(380, 780, 1)
    spectrum = colour.SDS_COLOURCHECKERS["ISO 17321-1"]["light skin"]
    aligned, observer, daylight = (
        each.copy().align(shape)
        for each in (
            spectrum,
            colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"],
            colour.SDS_ILLUMINANTS["D65"],
        )
    )
    xyz = colour.sd_to_XYZ(aligned, observer, daylight, method="Integration") / 100
    expected = colour.XYZ_to_sRGB(xyz, apply_cctf_encoding=False)
    found = spectrum.values @ sj.io.spectrum_to_rgb(spectrum.wavelengths)
    np.testing.assert_allclose(found, expected, rtol=5e-3)


def test_six_skins_descend_along_the_locus():
    import colour

    spectra = np.stack(
        [sj.scattering.Skin(melanin).half_space().total_reflectance() for melanin in SIX]
    )
    rgb = (SURFACE + (1 - SURFACE) * spectra) @ sj.io.spectrum_to_rgb(WAVELENGTHS)
    assert np.all(np.diff(rgb, axis=0) < 0)
    assert np.all(np.diff(rgb, axis=1) < 0)  # red above green above blue
    lab = colour.XYZ_to_Lab(colour.sRGB_to_XYZ(rgb, apply_cctf_decoding=False))
    for found, bounds in zip(lab.T[1:], LOCUS.values(), strict=True):
        low, high = (np.interp(lab[:, 0], LIGHTNESS, bound) for bound in bounds)
        np.testing.assert_allclose(found, np.clip(found, low, high), rtol=0, atol=NEAR)


@pytest.mark.once
@pytest.mark.parametrize(
    ("melanin", "lamp", "error"), [(0.02, "A", 2.0), (0.1, "LED-B1", 6.7), (0.26, "FL11", 4.3)]
)
def test_weights_for_daylight_are_off_under_a_lamp(melanin, lamp, error):
    """By the Delta E of docs/howto/fit.md, to an eye adapted to the lamp."""
    import colour

    to_rgb = colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
    tables = colour.SDS_ILLUMINANTS[lamp], colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    shape = colour.SpectralShape(380, 780, 1)
    light, observer = (each.copy().align(shape).values for each in tables)
    white = light @ observer
    spectrum = np.asarray(sj.scattering.Skin(melanin).half_space().total_reflectance())
    rgb = (spectrum @ sj.io.spectrum_to_rgb(WAVELENGTHS, name) for name in ("D65", lamp))
    xyz = (np.linalg.solve(to_rgb, each * (to_rgb @ white / white[1])) for each in rgb)
    lab = (colour.XYZ_to_Lab(each, colour.XYZ_to_xy(white)) for each in xyz)
    np.testing.assert_allclose(colour.delta_E(*lab, method="CIE 2000"), error, atol=0.1)


def test_a_projected_picture_is_the_picture_of_projected_weights():
    """Where the kernel has gain 1."""
    body, matrix = sphere(200), sj.io.spectrum_to_rgb(WAVELENGTHS)
    weights = 0.2 * np.random.default_rng(0).random((2, 31))
    settings = replace(PLAIN, kernel=sj.diffusion.PlainMean())
    light = sj.DirectionalLight([-0.5, -0.4, -1.0], 3.0)

    def picture(weights):
        material = sj.Material(sj.SumOfGaussians([0.5, 9.0], weights), specular=0.0)
        return np.asarray(sj.render(sj.Scene(body, light, material), view(), settings).beauty)

    # Black channels beside three: one program renders both pictures.
    three = picture(np.pad(weights @ matrix, ((0, 0), (0, 28))))[..., :3]
    assert three.max() > 0.1
    np.testing.assert_allclose(picture(weights) @ matrix, three, atol=1e-5)


@pytest.fixture(scope="module")
def patch():
    """A flat matte patch of the reflectance of a red, in 31 wavelengths, under gray light."""
    reflectance = 0.05 + 0.6 / (1 + np.exp((590 - WAVELENGTHS) / 12.0))
    gaussians = sj.SumOfGaussians([1e-6], reflectance[None])
    material = sj.Material(gaussians, eta=1.0, specular=0.0, wavelengths=WAVELENGTHS)
    light = sj.DirectionalLight([0, 0, -1], np.pi, cast_shadows=False)
    return sj.Scene(sheet(16.0, 1.0), light, material), camera_over(4.0, 8), PLAIN


@pytest.mark.parametrize("illuminant", ["D65", "A", "FL11", "LED-B1"])
def test_a_patch_in_gray_light_has_the_color_of_a_lamp(patch, illuminant, tmp_path):
    """To the eye adapted to the lamp: relative to white in linear sRGB."""
    import colour

    frame, material = sj.render(*patch), patch[0].material
    rgb = sj.io.picture_to_rgb(frame.beauty, material.wavelengths, illuminant)
    ours, white = material.total_reflectance(), np.ones(31)
    patch_rgb, white_rgb = (
        colour.XYZ_to_sRGB(tristimulus(each, illuminant), apply_cctf_encoding=False)
        for each in (ours, white)
    )
    np.testing.assert_allclose(rgb[4, 4], patch_rgb / white_rgb, rtol=1e-3)
    path, nodes = tmp_path / "patch.png", material.wavelengths
    sj.write_png(path, frame, wavelengths=nodes, illuminant=illuminant)
    with Image.open(path) as image:
        encoded = sj.io.linear_to_srgb(np.asarray(rgb))
        np.testing.assert_allclose(np.asarray(image) / 255, encoded, atol=1 / 255)


@pytest.mark.parametrize(("illuminant", "error"), [("D65", 0.1), ("A", 0.3), ("FL11", 0.7)])
def test_a_lamp_lights_a_patch_as_its_spectrum_does(patch, illuminant, error):
    """By the Delta E of docs/howto/fit.md: 31 samples of a lamp times those of the patch are less
    than the product of both spectra.
    """
    import colour

    scene, camera, settings = patch
    lamp = sj.io.illuminant(illuminant, WAVELENGTHS)
    lit = replace(scene, lights=sj.DirectionalLight([0, 0, -1], np.pi * lamp, cast_shadows=False))
    frame = sj.render(lit, camera, settings)
    rgb = np.asarray(sj.io.picture_to_rgb(frame.beauty, WAVELENGTHS, None), float)[4, 4]
    to_rgb = colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
    both = (
        np.linalg.solve(to_rgb, rgb),
        tristimulus(scene.material.gaussians.weights[0], illuminant),
    )
    white = colour.XYZ_to_xy(tristimulus(np.ones(31), illuminant))
    lab = (colour.XYZ_to_Lab(xyz, white) for xyz in both)
    assert colour.delta_E(*lab, method="CIE 2000") < error
    one = np.linalg.solve(to_rgb, lamp @ sj.io.spectrum_to_rgb(WAVELENGTHS, None))
    np.testing.assert_allclose(one[1], 1, rtol=1e-12)


def test_spectral_layers_come_back_and_are_read_by_colour_science(patch, tmp_path):
    import colour

    path, frame = tmp_path / "patch.exr", sj.render(*patch)
    sj.write_exr(path, frame, wavelengths=WAVELENGTHS)
    assert eqx.tree_equal(sj.read_exr(path), frame)
    nodes, picture = colour.io.read_spectral_image_Fichet2021(path)["S0"]
    np.testing.assert_array_equal(nodes, WAVELENGTHS)
    np.testing.assert_array_equal(picture, frame.beauty)
    assert_refused(lambda: sj.write_exr(path, frame, wavelengths=[500, 600]), "must be 31")
    assert_refused(lambda: sj.write_png(tmp_path / "a.png", frame), "31 channels")
    descending = WAVELENGTHS[::-1]
    assert_refused(
        lambda: sj.write_exr(path, frame, wavelengths=descending), "steps of wavelengths"
    )
    assert_refused(
        lambda: sj.write_png(tmp_path / "a.png", frame, wavelengths=[500, 600]), "must be 31"
    )


def test_a_material_keeps_its_wavelengths(tmp_path):
    weights = np.linspace(0.1, 0.2, 10).reshape(2, 5)
    nodes, gaussians = [420, 480.5, 550, 610, 690], sj.SumOfGaussians([0.5, 9.0], weights)
    material = sj.Material(gaussians, wavelengths=nodes)
    sj.save_material(material, tmp_path / "five.toml")
    assert eqx.tree_equal(sj.load_material(tmp_path / "five.toml"), material)
    for other in (material.white(), material.opaque()):
        np.testing.assert_array_equal(other.wavelengths, jnp.asarray(nodes))
    for wrong, message in (
        ([500, 600], r"wavelengths has shape \[2\].*\[5\]"),
        ([420, 550, 480, 610, 690], "steps of Material.wavelengths must be positive"),
        ([42, 48, 55, 61, 69], "wavelengths must be between 360 and 830"),
    ):
        assert_refused(lambda wrong=wrong: sj.Material(gaussians, wavelengths=wrong), message)
    stone = tmp_path / "stone.toml"
    medium = '[medium]\nunit = "1/mm"\nsigma_a = [0.1, 0.2]\nsigma_s_prime = 1.0\neta = 1.3\n'
    stone.write_text(f"wavelengths = [450, 550, 650]\n{medium}")
    assert_refused(lambda: sj.load_medium(stone), r"stone.toml.*wavelengths has shape \[3\]")
    stone.write_text("wavelengths = [450, 550]\n[skin]\nwavelengths = [450, 560]\n")
    assert_refused(lambda: sj.load_profile(stone), "stone.toml.*other wavelengths than its")
    exported = tmp_path / "five.mtlx"
    blue_first = sj.Material(
        sj.SumOfGaussians([1.0], [[0.1, 0.2, 0.3]]), wavelengths=[450, 550, 650]
    )
    assert_refused(lambda: sj.io.save_materialx(exported, blue_first), "3 wavelengths; give gray")


def test_pigments_to_weights_are_one_program():
    """In a process of its own: where all channels were computed at once, it never ended."""
    program = """
import jax, numpy as np, splatjax as sj
from splatjax.fitting import FixedTotalReflectance, TransportModel, fit_weights

@jax.jit
def fit(skin):
    profile = skin.profile()
    rule, held = TransportModel().rule, FixedTotalReflectance()
    gaussians = fit_weights(profile, [0.01, 0.1, 1.0, 10.0], weights=held, rule=rule)
    return gaussians.weights.sum(axis=0), profile.total_reflectance()

np.testing.assert_allclose(*fit(sj.scattering.Skin()), rtol=1e-4)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)


def test_an_unknown_illuminant_is_named():
    assert_refused(lambda: sj.io.illuminant("D66", WAVELENGTHS), "'D66' is unknown; .* 'D65'")
    assert_refused(lambda: sj.io.spectrum_to_rgb(WAVELENGTHS, "?"), "'\\?' is unknown; .* A, B")
    assert_refused(lambda: sj.io.spectrum_to_rgb([500, 450]), "wavelengths must be positive")
    for unseen in ([5000, 6000], []):
        assert_refused(lambda unseen=unseen: sj.io.spectrum_to_rgb(unseen), "wavelengths .* 780")


def test_a_skin_in_a_file_comes_back(tmp_path):
    path = tmp_path / "skin.toml"
    path.write_text("[skin]\nmelanin = 0.1\nwavelengths = [450, 550, 650]\n")
    skin = sj.load_profile(path)
    assert eqx.tree_equal(skin, sj.scattering.Skin(0.1, wavelengths=[450, 550, 650]))
    material = sj.Material(sj.SumOfGaussians([1.0], [[0.4, 0.2, 0.1]]))
    sj.save_material(material, path, profile=skin)
    assert eqx.tree_equal(sj.load_profile(path), skin)
