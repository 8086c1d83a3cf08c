"""Small scenes that together hold every float that a picture depends on: one record each, with what
to check of it.
"""

import dataclasses
from collections.abc import Callable, Iterator

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from bodies import view

import splatjax as sj

SHADOWS = sj.splatting.ShadowSettings(resolution=32, bias=0.4, softness=0.8)
FAST = sj.RenderSettings(
    shadows=SHADOWS,
    sample_shadows=SHADOWS,
    rasterizer=sj.splatting.TileRasterizer(lanes=8, slots=16),
)
PLAIN = dataclasses.replace(bodies.PLAIN, shadows=SHADOWS, sample_shadows=SHADOWS)
COARSE = dataclasses.replace(PLAIN, shadows=dataclasses.replace(SHADOWS, resolution=16))

SOLVED = dataclasses.replace(PLAIN, diffuser=sj.diffusion.ShapeDiffuser(error=1e-12))


class World(eqx.Module):
    scene: sj.Scene
    camera: sj.Camera


@dataclasses.dataclass(frozen=True)
class Small:
    make: Callable[[], World]
    paths: dict[str, sj.RenderSettings] = dataclasses.field(
        default_factory=lambda: {"plain": PLAIN}
    )


def _gaussians() -> sj.SumOfGaussians:
    return sj.SumOfGaussians([4.0, 30.0], [[0.5, 0.3], [0.2, 0.6]])


def _colored(body: sj.Splats, seed: int = 12) -> sj.Splats:
    albedo = np.random.default_rng(seed).uniform(0.2, 0.9, (body.count, 2))
    return bodies.with_albedo(body, albedo)


def uneven(body: sj.Splats) -> sj.Splats:
    """No two extents alike: where two splats share the largest, the bounds of the shadow maps have
    a kink.
    """
    rng = np.random.default_rng(8)
    radii = body.radii * jnp.asarray(rng.uniform(0.95, 1.05, body.count))
    centers = body.centers + jnp.asarray(rng.uniform(-0.05, 0.05, (body.count, 3)))
    return eqx.tree_at(lambda s: (s.centers, s.radii), body, (centers, radii))


def lamp_and_maps() -> World:
    """A body in its own shadow, with every map a splat can carry, under a point light around whose
    frustum a map is made.
    """
    body = _colored(bodies.bumpy(240))
    maps = jnp.asarray(np.random.default_rng(3).uniform(0.5, 1.5, (2, body.count)))
    weights = jnp.asarray(np.random.default_rng(7).uniform(0.3, 1.5, (body.count, 2, 2)))
    given = {"specular": maps[0], "roughness": maps[1], "weights": weights}
    splats = dataclasses.replace(body, **given)
    lights = (sj.PointLight([-14.0, 18.0, 25.0], [9e3, 5e3]),)
    return World(sj.Scene(splats, lights, sj.Material(_gaussians())), view())


def sun_and_beam() -> World:
    lights = (
        sj.DirectionalLight([-0.6, -0.4, -0.7], [2.0, 3.0], cast_shadows=False),
        sj.GaussianBeam([2.0, 3.0, 30.0], [-0.1, 0.1, -1.0], [400.0, 600.0], 20.0),
        sj.scene.SpotLight([3.0, 9.0, 30.0], [0, -9, -30], [5e2, 9e2], 5, 25, cast_shadows=False),
    )
    camera = dataclasses.replace(view(), principal_point=jnp.asarray([0.47, 0.56]))
    return World(sj.Scene(_colored(bodies.bumpy(240)), lights, sj.Material(_gaussians())), camera)


def lamp_inside() -> World:
    body = uneven(
        bodies.joined(
            bodies.sphere(120, 6.0, (-7.0, 0.0, 0.0)),
            bodies.sphere(120, 5.0, (7.0, 1.0, 0.0), seed=1),
        )
    )
    lights = (sj.PointLight([0.3, 0.4, 5.0], [90.0, 50.0]),)
    return World(sj.Scene(body, lights, sj.Material(_gaussians())), view())


def ball_over_sheet() -> World:
    body = uneven(
        bodies.joined(
            bodies.sheet(14.0, 2.2, center=(0.3, 0.2, -6.0)),
            bodies.sphere(160, 4.5, (1.0, 0.5, 2.0)),
        )
    )
    lights = (sj.DirectionalLight([-0.5, -0.3, -1.0], [2.0, 3.0]),)
    return World(sj.Scene(body, lights, sj.Material(_gaussians())), view((3.0, 2.0, 40.0), 30.0))


def scattered_once() -> World:
    medium = sj.Medium([0.1, 0.05], [0.9, 1.2], [1.3, 1.5])
    single = sj.SingleScattering(medium, [0.9, 1.0])
    gaussians = sj.SumOfGaussians([4.0, 30.0], [[0.4, 0.5], [0.3, 0.3]])
    light = sj.DirectionalLight([-1.0, -0.2, 0.1], [2.0, 3.0], cast_shadows=False)
    angles = sj.scattering.AngularLaw([[0.9, 1.2], [0.2, -0.3], [-0.1, 0.1]])
    material = sj.Material(gaussians, single_scattering=single, angles=angles)
    return World(sj.Scene(_colored(bodies.bumpy(160)), (light,), material), view())


def solved_body() -> World:
    medium = sj.Medium([0.02, 0.05], [0.9, 1.2], [1.3, 1.5])
    light = sj.DirectionalLight([-1.0, -0.2, -0.6], [2.0, 3.0], cast_shadows=False)
    body = uneven(_colored(bodies.sphere(80, 4.0)))
    return World(sj.Scene(body, (light,), sj.Material(_gaussians(), medium=medium)), view())


def extended_lights() -> World:
    """A body in its own shadow, under lights that are sampled, with a highlight each."""
    image = np.random.default_rng(4).uniform(0.1, 2.0, (6, 12, 2))
    lights = (
        sj.EnvironmentLight(image, 40.0, [0.6, 0.5], (0.2, 1.0, 0.3), count=4),
        sj.scene.RectangleLight([-14, 18, 25], [8, 5], [[6, 0, 5], [0, -7, 3]], count=2),
        sj.scene.DiskLight([12, -9, 30], [6, 8], [-0.3, 0.3, -1], 4.0, count=2),
        sj.scene.SphereLight([16, 14, 22], [9, 4], 3.0, count=2),
        sj.EnvironmentLight(image, -20.0, 0.4, directions=[[1, 2, 2], [-2, 1, 1], [0, -1, 3]]),
        sj.scene.HarmonicLight([[3.0, 2.0], [0.3, -0.2], [0.5, 0.4], [-0.2, 0.6]], count=4),
    )
    body = uneven(_colored(bodies.bumpy(160)))
    return World(sj.Scene(body, lights, sj.Material(_gaussians(), roughness=0.4)), view())


# The plain path is checked everywhere; the fast one where all its parts take part, and against the
# plain one.
WORLDS = {
    "lamp and maps": Small(lamp_and_maps, {"fast": FAST, "plain": PLAIN}),
    "sun and beam": Small(sun_and_beam),
    "lamp inside": Small(lamp_inside, {"plain": COARSE}),
    "ball over sheet": Small(ball_over_sheet),
    "scattered once": Small(scattered_once),
    "solved body": Small(solved_body, {"solved": SOLVED}),
    "extended lights": Small(extended_lights),
}


def named(world: World) -> dict[str, jax.Array]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(world)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def with_leaf(world: World, name: str, value: jax.Array) -> World:
    leaves, structure = jax.tree.flatten(world)
    leaves[list(named(world)).index(name)] = value
    return jax.tree.unflatten(structure, leaves)


def fields_of(record: eqx.Module) -> Iterator[tuple[str, bool]]:
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        for each in value if isinstance(value, tuple) else (value,):
            if not field.metadata.get("static"):
                yield f"{type(record).__name__}.{field.name}", each is not None
            if isinstance(each, eqx.Module):
                yield from fields_of(each)
