"""No length in the renderer is absolute: a body, its light and what spreads in it, larger or
smaller as a whole.
"""

import bodies
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj


@pytest.mark.once
def test_a_scaled_body_in_scaled_light_gives_the_same_picture():
    """From 0.7 mm to 66 m: a bumpy body in its own shadow, under a lamp far away and one near, and
    a softbox.
    """
    body = bodies.with_albedo(bodies.bumpy(900), np.full((900, 3), 0.7))

    def picture(scale: float) -> sj.Frame:
        lamp = sj.PointLight(scale * np.asarray([-12.0, 12.0, 20.0]), 400 * scale**2)
        softbox = sj.scene.RectangleLight.facing(
            scale * np.asarray([20.0, 5, 14]), (0, 0, 0), 8 * scale, 8 * scale, 5, count=4
        )
        lights = sj.DirectionalLight((0.9, -0.3, -0.4), 2), lamp, softbox
        gaussians = sj.SumOfGaussians(scale**2 * jnp.asarray([1.0, 8.0]), [[0.5] * 3, [0.4] * 3])
        camera = sj.Camera.look_at(
            scale * np.asarray([3.0, 2, 40]), (0, 0, 0), fov=35, width=32, height=32
        )
        scene = sj.Scene(body.scaled(scale), lights, sj.Material(gaussians, specular=0.5))
        return sj.render(scene, camera, bodies.PLAIN)

    usual = picture(1.0)
    shadow = np.asarray(usual.shadow)
    assert np.mean(shadow < 0.5) > 0.01
    for scale in (0.03, 3000.0):
        scaled = picture(scale)
        np.testing.assert_allclose(scaled.beauty, usual.beauty, atol=2e-3)
        np.testing.assert_allclose(scaled.shadow, shadow, atol=1e-2)
