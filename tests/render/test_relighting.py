"""Relighting by spherical harmonics: a kept view against the picture that is rendered."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import PLAIN, apart, irradiance, joined, map_directions, sphere, two_gaussians

import splatjax as sj
from splatjax.scene import HarmonicLight, spherical_harmonics

MEDIUM = sj.Medium([0.1, 0.02, 0.5], [0.9, 0.98, 0.5], 1.3)
MATERIAL = sj.Material(two_gaussians(), specular=0.5, single_scattering=sj.SingleScattering(MEDIUM))
BODY = joined(sphere(500, 10.0), sphere(100, 3.0, (4.0, 6.0, 12.0)))
CAMERA = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=24, width=24, height=24)
HARMONIC = {64: 0.03, 256: 0.004}  # largest error of the irradiance, by count


DARK = HarmonicLight(np.zeros((9, 3)), count=12)


@pytest.mark.once
def test_a_kept_view_is_the_picture_with_its_gradient():
    """In the pixels and the rotation of an environment, and under light of both signs."""
    rng = np.random.default_rng(0)
    image, factors = jnp.asarray(rng.uniform(size=(8, 16, 3))), rng.normal(size=(24, 24, 3))
    scene = sj.Scene(BODY, DARK, MATERIAL)
    plan = sj.make_plan(scene, CAMERA, PLAIN)
    kept = sj.transfer(scene, plan, PLAIN)
    basis = sj.relighting_basis(scene, CAMERA, PLAIN, plan, light=kept)

    def rendered(light):
        scene = sj.Scene(BODY, light, MATERIAL)
        return sj.render(scene, CAMERA, PLAIN, plan, light=kept).beauty

    def weighed(picture):
        def of(image, rotation):
            beauty = picture(HarmonicLight.of(sj.EnvironmentLight(image, rotation), 2, count=12))
            return jnp.vdot(factors, beauty), beauty

        return jax.jit(jax.value_and_grad(of, (0, 1), has_aux=True))(image, 40.0)

    assert max(apart(weighed(basis.beauty), weighed(rendered)).values()) < 2e-5
    few = np.pad(image[0, :4], ((0, 5), (0, 0)))
    assert np.array_equal(*(basis.beauty(HarmonicLight(each)) for each in (few, few[:4])))
    with pytest.raises(ValueError, match=r"light has 16 harmonics, and the basis .* for 9"):
        basis.beauty(HarmonicLight(np.zeros((16, 3))))


@pytest.mark.once
@pytest.mark.parametrize("count", HARMONIC)
def test_irradiance_on_a_ball_is_that_of_its_bands(count):
    """pi, 2 pi / 3, pi / 4 and 0 times the radiance, for each harmonic up to the third band."""
    body = sphere(300)
    factor = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    exact = factor * np.asarray(spherical_harmonics(body.normals, 3))
    gaussians = sj.SumOfGaussians([1.0], np.ones((1, 16)))
    light = HarmonicLight(np.eye(16), count=count, cast_shadows=False)  # one for each channel
    scene = sj.Scene(body, light, sj.Material(gaussians, eta=1.0, specular=0.0))
    assert np.max(np.abs(irradiance(scene).T - exact)) < HARMONIC[count]


def test_an_environment_of_one_harmonic_has_its_coefficient():
    """Turned by 90 degrees about y, the harmonics of z and x are those of x and -z."""
    eye = np.eye(4)[:, [0, 2, 3]]
    image = 1 + HarmonicLight(eye).radiance(jnp.asarray(map_directions(128)))
    even = np.sqrt(4 * np.pi) * np.eye(9)[:, :1]
    for rotation, expected in ((0.0, eye), (90.0, np.eye(4)[:, [0, 3, 2]] * [1, 1, -1])):
        light = HarmonicLight.of(sj.EnvironmentLight(image, rotation), 2)
        np.testing.assert_allclose(
            light.coefficients, even + np.pad(expected, ((0, 5), (0, 0))), atol=2e-3
        )
