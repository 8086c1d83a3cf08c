"""Single scattering as a term of its own in a picture: its formula, its sum, its color, its
file.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import sheet

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.scattering import SingleScattering
from splatjax.splatting import DenseRasterizer

COLORS = (0.25, 0.5, 1.0)
# A sheet of a thousand splats and pictures of a few pixels: the plain path compiles in a third of
# the time.
PLAIN = sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())


def material(eta=1.3):
    medium = sj.Medium([0.1, 0.02, 0.5], [0.9, 0.98, 0.5], jnp.full(3, eta))
    gaussians = sj.SumOfGaussians([1.0, 4.0], [[0.1, 0.2, 0.05], [0.1, 0.3, 0.02]])
    return sj.Material(gaussians, eta=eta, specular=0.0, single_scattering=SingleScattering(medium))


def picture(material):
    """Of a sheet of three colors."""
    splats = sheet(3.0, 0.2)
    colors = jnp.broadcast_to(jnp.asarray(COLORS, float), splats.centers.shape)
    splats = eqx.tree_at(lambda s: s.albedo, splats, colors, is_leaf=lambda leaf: leaf is None)
    light = sj.DirectionalLight([0.6, 0.0, -0.8], [1.0, 2.0, 3.0], cast_shadows=False)
    camera = sj.Camera.look_at([0, 3, 4], [0, 0, 0], fov=2, width=4, height=4)
    return sj.render(sj.Scene(splats, (light,), material), camera, PLAIN)


@pytest.fixture(scope="module")
def frame():
    return picture(material())


@pytest.mark.once
def test_it_is_its_formula_and_part_of_the_beauty(frame):
    """The albedo colors it as it colors the rest."""
    lit, entered = material(), 0.8 * np.asarray([1.0, 2.0, 3.0])
    reflected = lit.single_scattering.reflected(jnp.asarray(0.8), jnp.asarray(0.8))
    expected = np.asarray(reflected) * entered * COLORS
    np.testing.assert_allclose(frame.single_scattering[2, 2], expected, rtol=1e-3)
    parts = frame.diffuse + frame.specular + frame.single_scattering
    np.testing.assert_allclose(frame.beauty, parts, rtol=1e-6)
    plain = picture(lit.surface_of(lit.gaussians))
    assert plain.single_scattering is None
    np.testing.assert_allclose(plain.diffuse, frame.diffuse, rtol=1e-5)


def test_white_returns_all():
    white = material().white()
    np.testing.assert_allclose(np.asarray(white.total_reflectance()), 1, rtol=1e-5)
    ratio = np.asarray(material().total_reflectance())
    np.testing.assert_allclose(np.asarray(white.single_scattering.strength), 1 / ratio, rtol=1e-5)


@pytest.mark.parametrize("eta", [1.0, 1.3])
def test_no_more_leaves_than_came_however_the_light_grazes(eta):
    """What scatters once and what diffuses add up to one at most, and to one where nothing is
    absorbed or reflected.
    """
    mu = jnp.asarray([1.0, 0.5, 0.2, 0.05, 0.0])
    for absorbing in (0.0, 0.002, 0.1):
        medium = sj.Medium([absorbing], [1 - absorbing], eta)
        single = SingleScattering(medium)
        rest = (0.95 if absorbing else 1.0) * (1 - single.total_reflectance())
        lit = sj.Material(sj.SumOfGaussians([1.0], rest[None]), single_scattering=single)
        for each in (lit, lit.white()):
            diffused = each.gaussians.total_reflectance()[None] * each.diffuse_fraction(mu)
            leaving = each.single_scattering.directional_albedo(mu) + diffused
            assert np.all(np.asarray(leaving) <= 1 + 2e-3)
            if absorbing == 0:
                np.testing.assert_allclose(np.asarray(leaving), 1, atol=2e-3)
        np.testing.assert_allclose(np.asarray(lit.diffuse_fraction(mu[:1])), 1, atol=2e-3)


@pytest.mark.once
def test_files_keep_it(tmp_path, frame):
    lit = material().white()
    sj.save_material(lit, tmp_path / "jade.toml")
    loaded = jax.tree.leaves(sj.load_material(tmp_path / "jade.toml"))
    for ours, theirs in zip(loaded, jax.tree.leaves(lit), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    sj.write_exr(tmp_path / "jade.exr", frame)
    read = sj.read_exr(tmp_path / "jade.exr")
    np.testing.assert_array_equal(
        read.single_scattering, np.asarray(frame.single_scattering, np.float32)
    )


def test_other_channels_are_refused():
    lit = material()
    other = sj.Medium(jnp.ones(2), jnp.ones(2), jnp.ones(2))
    wrong = sj.Material(lit.gaussians, single_scattering=SingleScattering(other))
    with pytest.raises(ValueError, match=r"single_scattering\.medium has 2 channels"):
        picture(wrong)
