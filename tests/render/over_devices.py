"""Run by test_devices.py in processes of their own: what their devices find, as JSON."""

import json
import sys
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from bodies import PLAIN, TILED, apart, joined, sphere, with_albedo
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import NamedSharding, PartitionSpec

import splatjax as sj
from benchmarks.communication import Picture, View, counted

# mm; where the balls stand, away from the origin of all coordinates.
PLACE = np.asarray([40.0, -25.0, 15.0])
LAMP = np.add(PLACE, [-60.0, 10.0, 20.0])


def scene(count: int = 1501, variances=(0.1, 12.5, 100.0)) -> sj.Scene:
    """Two balls, the last splats before the first, of a number that eight does not divide; layers
    of three kinds.
    """
    splats = joined(
        sphere(count - count // 5, 20.0, PLACE, jitter=0.0),
        sphere(count // 5, 6.0, np.add(PLACE, [-8.0, 6.0, 30.0]), jitter=0.0),
    )
    splats = with_albedo(splats, 0.6 + 0.3 * np.sin((np.asarray(splats.centers) - PLACE) / 5))
    weights = [[0.2, 0.1, 0.1], [0.3, 0.3, 0.2], [0.3, 0.2, 0.1]][-len(variances) :]
    lights = (
        sj.DirectionalLight([0.4, -0.5, -1.0], [1, 1, 1]),
        sj.PointLight(LAMP, [2000, 2000, 2000], cast_shadows=False),
    )
    return sj.Scene(splats, lights, sj.Material(sj.SumOfGaussians(variances, weights)))


def camera(angle: float = 0.0) -> sj.Camera:
    eye = np.add(PLACE, [80 * np.sin(angle), 6.0, 80 * np.cos(angle)])
    return sj.Camera.look_at(eye, PLACE, fov=34.0, width=44, height=40)


@eqx.filter_jit
def pictured(scene: sj.Scene, camera: sj.Camera, plan: sj.Plan):
    def loss(of):
        frame = sj.render(*of, TILED, plan)
        wave = jnp.sin(jnp.arange(frame.beauty.size, dtype=float)).reshape(frame.beauty.shape)
        total = jnp.sum(wave * (frame.beauty + 1e-3 * frame.position))
        return total + jnp.sum(frame.coverage**2), frame

    return eqx.filter_grad(loss, has_aux=True)((scene, camera))


def splats_cut() -> dict:
    """Under lights with shadows, of one sample and of several."""
    lights = (
        *scene().lights,
        sj.EnvironmentLight(np.random.default_rng(4).uniform(0.1, 2.0, (6, 12, 3)), count=5),
        sj.scene.RectangleLight(LAMP, 6.0, [[0, 0, 20], [0, 20, 0]], count=3),
    )
    return _apart_on_eight(replace(scene(), lights=lights))


# Gradients without a shadow map: it takes half the time to compile.
def light_and_unshadowed_splats_cut() -> dict:
    world, meshes = scene(), (None, jax.make_mesh((8,), ("splats",)))
    light = apart(
        *(
            sj.compute_irradiance(world, sj.make_plan(world, camera(), TILED, mesh=mesh), TILED)
            for mesh in meshes
        )
    )
    return light | _apart_on_eight(replace(world, lights=world.lights[1:]))


def _apart_on_eight(world: sj.Scene) -> dict:
    eye, mesh = camera(), jax.make_mesh((4, 2), ("hosts", "devices"))
    plans = [sj.make_plan(world, eye, TILED), sj.make_plan(world, eye, TILED, mesh=mesh)]
    # Layers that are not resolved, from single splats, from clusters.
    diffusion = plans[0].diffusion
    np.testing.assert_array_equal(diffusion.gaussians, [1, 2])
    splats, clusters = (len(np.unique(each)) for each in np.asarray(diffusion.sources.parents))
    assert splats == len(plans[0].order) > clusters
    one, many = (pictured(world, eye, plan) for plan in plans)
    assert many[1].overflow == 0
    # The derivative in the lobe's strength nearly vanishes here; the lobe's numbers are one kind.
    return apart(*(_with_one_lobe(each) for each in (one, many)))


def _with_one_lobe(found):
    material = found[0][0].material
    lobe = jnp.stack([material.eta, material.specular, material.roughness])
    return lobe, eqx.tree_at(lambda each: each[0][0].material, found, material.gaussians)


def more_than_pictures_cut() -> dict:
    """What else is made of splats that are cut: the Jacobian, the picture of any weights, light on
    splats, pass 4 alone.
    """
    world, eye = scene(), camera()
    mesh = jax.make_mesh((8,), ("splats",))
    other = sj.SumOfGaussians(
        world.material.gaussians.variances, world.material.gaussians.weights[::-1]
    )

    def found(mesh):
        plan = sj.make_plan(world, eye, TILED, mesh=mesh)
        light = sj.compute_irradiance(world, plan, TILED)
        gathered = sj.diffusion_basis(world, eye, TILED, plan, derivative=True)
        diffused = sj.diffuse_irradiance(world, light.source.T, eye, TILED, plan)
        jacobian = sj.picture_jacobian(world, eye, TILED, plan)
        bounces = replace(TILED, bounces=1)
        bounced = sj.compute_irradiance(
            world, sj.make_plan(world, eye, bounces, mesh=mesh), bounces
        )
        assert not np.allclose(bounced.entering, light.entering, rtol=1e-3)
        return light, bounced, diffused, gathered.beauty(other), gathered.coverage, jacobian

    return apart(found(None), found(mesh))


def traffic() -> dict:
    """The collectives of the compiled program against the model, with splats that lie where they
    are worked on.
    """
    mesh = jax.make_mesh((8,), ("splats",))
    world = scene(1504)
    plan = sj.make_plan(world, camera(), TILED, mesh=mesh)
    splats = jax.device_put(world.splats, NamedSharding(mesh, PartitionSpec("splats")))
    program = jax.jit(
        lambda splats: sj.render(replace(world, splats=splats), camera(), TILED, plan)
    )
    found = counted(program.lower(splats).compile().as_text())
    layers = len(plan.diffusion.gaussians)
    shadows = [each.raster for each in plan.shadows if each is not None]
    picture = Picture(
        camera=View(30, *_capacity(plan.raster)),
        maps=tuple(View(16, *_capacity(each)) for each in shadows),
        rows=17 + 16 * layers,
        channels=3,
        gaussians=3,
        lights=2,
        splats=len(plan.order),
    )
    model = vars(picture.traffic()) | {"sent": picture.sent(8)}
    model["scattered"] /= 8
    return {"model": model, "counted": vars(found) | {"sent": found.sent(8)}}


def _capacity(raster) -> tuple[int, int]:
    return raster.places.front, raster.places.behind


def views_cut() -> dict:
    world, cameras = scene(97), [camera(angle) for angle in (0.0, 1.0, 2.0)]
    world = replace(world, lights=world.lights[1:])
    plan = sj.make_plan(world, cameras, PLAIN)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    mesh = jax.make_mesh((8,), ("views",))

    def draw(scene, camera):
        return sj.render(scene, camera, PLAIN, plan)

    def one_by_one(scene, cameras):
        return jax.lax.map(lambda camera: draw(scene, camera), cameras)

    def found(draw_all):
        def loss(of):
            frames = draw_all(*of)
            return jnp.sum(frames.beauty**2) + jnp.sum(frames.coverage), frames

        return eqx.filter_jit(eqx.filter_grad(loss, has_aux=True))((world, stacked))

    return apart(found(one_by_one), found(partial(sj.map_over, mesh, draw)))


def over_processes(what: str, index: str, count: str, port: str) -> dict:
    """The splats of one scene on the devices of several processes, of which this is one: the
    picture, or the gradients of what soon compiles. The first process compares with one device of
    its own.
    """
    jax.distributed.initialize(f"127.0.0.1:{port}", int(count), int(index))
    mesh = jax.make_mesh((jax.device_count(),), ("splats",))
    # A layer of single splats, and one of clusters.
    world, eye = scene(1504, variances=(16.0, 100.0)), camera()
    splats = jax.device_put(world.splats, NamedSharding(mesh, PartitionSpec("splats")))

    def found(splats, mesh):
        plan = sj.make_plan(replace(world, splats=splats), eye, TILED, mesh=mesh)

        def draw(splats, plan):
            return sj.render(replace(world, splats=splats), eye, TILED, plan)

        if what == "picture":
            return draw(splats, plan)
        return eqx.filter_jit(
            eqx.filter_grad(lambda splats, plan: jnp.sum(draw(splats, plan).coverage ** 2))
        )(splats, plan)

    answer, rows = found(splats, mesh), []
    if what == "gradients":
        rows = [shard.data.shape[0] for shard in answer.centers.addressable_shards]
        answer = process_allgather(answer, tiled=True)
    return {
        "devices": jax.device_count(),
        "rows": rows,
        "apart": apart(found(world.splats, None), answer) if index == "0" else {},
    }


if __name__ == "__main__":
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    question, *given = sys.argv[1:]
    print(json.dumps(globals()[question](*given)))
