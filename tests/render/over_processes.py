"""Run by test_devices.py, once for each of several processes: the splats of one scene lie on the
devices of all of them.

The first process compares with one device of its own.
"""

import json
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
from bodies import apart
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import NamedSharding, PartitionSpec
from over_devices import SETTINGS, camera, scene

import splatjax as sj


def main(what: str, index: int, count: int, port: int) -> dict:
    """Give the picture, or the gradients of what soon compiles, and how the first process finds
    them.
    """
    jax.distributed.initialize(f"127.0.0.1:{port}", count, index)
    mesh = jax.make_mesh((jax.device_count(),), ("splats",))
    world, eye = (
        scene(1504, variances=(16.0, 100.0)),
        camera(),
    )  # a layer of single splats, and one of clusters
    cut = NamedSharding(mesh, PartitionSpec("splats"))
    splats = jax.tree.map(lambda leaf: jax.device_put(leaf, cut), world.splats)

    def found(splats, mesh):
        cut_scene = sj.Scene(splats, world.lights, world.material)
        plan = sj.make_plan(cut_scene, eye, SETTINGS, mesh=mesh)

        def draw(splats, plan):
            return sj.render(sj.Scene(splats, world.lights, world.material), eye, SETTINGS, plan)

        if what == "picture":
            return draw(splats, plan)
        return eqx.filter_jit(
            eqx.filter_grad(lambda splats, plan: jnp.sum(draw(splats, plan).coverage ** 2))
        )(splats, plan)

    answer = found(splats, mesh)
    if what == "gradients":
        rows = [shard.data.shape[0] for shard in answer.centers.addressable_shards]
        answer = process_allgather(answer, tiled=True)
    else:
        rows = []
    return {
        "devices": jax.device_count(),
        "rows": rows,
        "apart": apart(found(world.splats, None), answer) if index == 0 else {},
    }


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], *map(int, sys.argv[2:]))))
