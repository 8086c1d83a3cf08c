"""What reference pages take for granted, small: pages that teach stand for themselves."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import NamedSharding, PartitionSpec

import splatjax as sj

_SIDE = 24
PAGES = {f"docs/{name}.md" for name in ("devices", "gradients", "figures", "baselines", "recovery")}


def context() -> dict[str, Any]:
    """Make a scene of marble, its picture, and what cuts it over devices."""
    bust = sj.bust(900)
    splats = sj.Splats(bust.centers / 8, bust.normals, bust.radii / 8, bust.areas / 64)
    camera = sj.Camera.look_at([8, 0, 70], [0, -3.5, 0], fov=32.0, width=_SIDE, height=_SIDE)
    lights = (sj.DirectionalLight([-1, -0.3, -0.4], jnp.full(3, jnp.pi)),)
    marble = sj.load_material("marble")
    material = sj.Material(marble.gaussians, eta=1.5, specular=0.0)
    scene = sj.Scene(splats, lights, material)
    plan = sj.make_plan(scene, camera)
    picture = np.asarray(sj.render(scene, camera, plan=plan).beauty)
    return {
        "jax": jax,
        "jnp": jnp,
        "np": np,
        "optax": optax,
        "sj": sj,
        "splatjax": sj,
        "NamedSharding": NamedSharding,
        "PartitionSpec": PartitionSpec,
        "splats": splats,
        "camera": camera,
        "cameras": jax.tree.map(lambda leaf: jnp.stack([leaf] * jax.device_count()), camera),
        "lights": lights,
        "medium": sj.load_medium("marble"),
        "material": material,
        "scene": scene,
        "plan": plan,
        "picture": picture,
        "noise": np.full(picture.shape, 0.01 * float(np.sqrt(np.mean(picture**2)))),
        "target": jnp.zeros((_SIDE, _SIDE, 3)),
    }
