"""Run by test_devices.py, once for each of several processes: the splats of one scene lie on the devices of all of them."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from over_devices import SETTINGS, apart, camera, scene

import splatjax as sj


def main(index: int, count: int, port: int) -> dict:
    """Compare with the same on one device of this process."""
    jax.distributed.initialize(f"127.0.0.1:{port}", count, index)
    mesh = jax.make_mesh((jax.device_count(),), ("splats",))
    world, eye = scene(1504), camera()
    cut = NamedSharding(mesh, PartitionSpec("splats"))
    splats = jax.tree.map(lambda leaf: jax.device_put(leaf, cut), world.splats)

    def covered(splats, plan):
        frame = sj.render(sj.Scene(splats, world.lights, world.material), eye, SETTINGS, plan)
        return jnp.sum(frame.coverage**2) + jnp.sum(frame.position)

    plan = sj.plan(sj.Scene(splats, world.lights, world.material), eye, SETTINGS, mesh=mesh)
    frame = sj.render(sj.Scene(splats, world.lights, world.material), eye, SETTINGS, plan)
    gradients = jax.jit(jax.grad(lambda splats: covered(splats, plan)))(splats)
    alone = sj.plan(world, eye, SETTINGS)
    expected = jax.jit(jax.grad(lambda splats: covered(splats, alone)))(world.splats)
    own = list(gradients.centers.addressable_shards)
    errors = [np.abs(np.asarray(shard.data) - np.asarray(expected.centers)[shard.index]).max() for shard in own]
    return {
        "devices": jax.device_count(),
        "rows": [shard.data.shape[0] for shard in own],
        "frame": apart(sj.render(world, eye, SETTINGS, alone), frame),
        "gradients": float(max(errors) / np.abs(np.asarray(expected.centers)).max()),
    }


if __name__ == "__main__":
    print(json.dumps(main(*map(int, sys.argv[1:]))))
