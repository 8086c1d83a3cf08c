"""Single scattering as a term of its own in a picture: its formula, its sum, its color, its
file.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.scattering import SingleScattering
from splatjax.splatting import DenseRasterizer

# A sheet of a thousand splats and pictures of a few pixels: the plain path compiles in a third of
# the time.
PLAIN = sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())


def material(eta=1.3):
    medium = sj.Medium(
        jnp.asarray([0.1, 0.02, 0.5]), jnp.asarray([0.9, 0.98, 0.5]), jnp.full(3, eta)
    )
    gaussians = sj.SumOfGaussians(
        jnp.asarray([1.0, 4.0]), jnp.asarray([[0.1, 0.2, 0.05], [0.1, 0.3, 0.02]])
    )
    return sj.Material(gaussians, eta=eta, specular=0.0, single_scattering=SingleScattering(medium))


def sheet(albedo=None):
    count = 31
    x, y = np.meshgrid(np.linspace(-3, 3, count), np.linspace(-3, 3, count))
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    up = np.broadcast_to([0.0, 0.0, 1.0], centers.shape)
    colors = None if albedo is None else jnp.broadcast_to(jnp.asarray(albedo, float), centers.shape)
    area = np.full(x.size, 0.04)
    return sj.Splats(
        *(jnp.asarray(each, float) for each in (centers, up, 1.5 * np.sqrt(area), area)), colors
    )


def picture(material, albedo=None):
    light = sj.DirectionalLight(
        jnp.asarray([0.6, 0.0, -0.8]), jnp.asarray([1.0, 2.0, 3.0]), cast_shadows=False
    )
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 3.0, 4.0]), jnp.zeros(3), fov=2.0, width=4, height=4
    )
    return sj.render(sj.Scene(sheet(albedo), (light,), material), camera, PLAIN)


@pytest.mark.once
def test_it_is_its_formula_and_part_of_the_beauty():
    lit = material()
    frame = picture(lit)
    entered = 0.8 * np.asarray([1.0, 2.0, 3.0])
    expected = (
        np.asarray(lit.single_scattering.reflected(jnp.asarray(0.8), jnp.asarray(0.8))) * entered
    )
    np.testing.assert_allclose(np.asarray(frame.single_scattering)[2, 2], expected, rtol=1e-3)
    parts = frame.diffuse + frame.specular + frame.single_scattering
    np.testing.assert_allclose(np.asarray(frame.beauty), np.asarray(parts), rtol=1e-6)
    plain = picture(lit.surface_of(lit.gaussians))
    assert plain.single_scattering is None
    np.testing.assert_allclose(np.asarray(plain.diffuse), np.asarray(frame.diffuse), rtol=1e-5)


@pytest.mark.once
def test_albedo_colors_it_as_it_colors_the_rest():
    lit, colors = material(), [0.25, 0.5, 1.0]
    colored, plain = picture(lit, colors), picture(lit)
    np.testing.assert_allclose(
        np.asarray(colored.single_scattering),
        np.asarray(plain.single_scattering) * np.asarray(colors),
        rtol=1e-4,
    )


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
        medium = sj.Medium(jnp.full(1, absorbing), jnp.full(1, 1 - absorbing), jnp.full(1, eta))
        single = SingleScattering(medium)
        rest = (
            0.95 * (1 - float(single.total_reflectance()[0]))
            if absorbing
            else 1 - float(single.total_reflectance()[0])
        )
        lit = sj.Material(
            sj.SumOfGaussians(jnp.asarray([1.0]), jnp.asarray([[rest]])), single_scattering=single
        )
        for each in (lit, lit.white()):
            diffused = each.gaussians.total_reflectance()[None] * each.diffuse_fraction(mu)
            leaving = each.single_scattering.directional_albedo(mu) + diffused
            assert np.all(np.asarray(leaving) <= 1 + 2e-3)
            if absorbing == 0:
                np.testing.assert_allclose(np.asarray(leaving), 1, atol=2e-3)
        np.testing.assert_allclose(np.asarray(lit.diffuse_fraction(mu[:1])), 1, atol=2e-3)


@pytest.mark.once
def test_files_keep_it(tmp_path):
    lit = material().white()
    sj.save_material(lit, tmp_path / "jade.toml")
    for ours, theirs in zip(
        jax.tree.leaves(sj.load_material(tmp_path / "jade.toml")), jax.tree.leaves(lit), strict=True
    ):
        np.testing.assert_allclose(np.asarray(ours), np.asarray(theirs), rtol=1e-6)
    frame = picture(lit)
    sj.write_exr(tmp_path / "jade.exr", frame)
    read = sj.read_exr(tmp_path / "jade.exr")
    np.testing.assert_array_equal(
        np.asarray(read.single_scattering), np.asarray(frame.single_scattering, np.float32)
    )


def test_other_channels_are_refused():
    lit = material()
    other = sj.Medium(jnp.ones(2), jnp.ones(2), jnp.ones(2))
    wrong = sj.Material(lit.gaussians, single_scattering=SingleScattering(other))
    with pytest.raises(ValueError, match=r"single_scattering\.medium has 2 channels"):
        picture(wrong)
