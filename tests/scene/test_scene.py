"""What a scene is made of."""

import equinox as eqx
import jax.numpy as jnp
import pytest

import splatjax as sj


def test_one_light_is_still_a_tuple_of_lights():
    light = sj.DirectionalLight(direction=jnp.asarray([0.0, 0.0, -1.0]), irradiance=jnp.ones(3))
    scene = sj.Scene(sj.bust(10), (light,), sj.load_material("skin"))
    wrong = eqx.tree_at(
        lambda scene: scene.lights, scene, light
    )  # the tests' checks of types come before it otherwise
    with pytest.raises(
        TypeError,
        match=r"lights is a DirectionalLight; it must be a tuple of lights: \(light,\) for one",
    ):
        wrong.__check_init__()
    scene.__check_init__()
