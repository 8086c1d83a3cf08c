"""Bodies and views to splat, shared by all tests: normals and areas are those of the surface."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax._combination import DeviceMesh
from splatjax.render import RenderSettings, compute_irradiance, make_plan
from splatjax.splatting import (
    AbstractRasterPlan,
    AbstractView,
    DenseRasterizer,
    OrthographicView,
    PerspectiveView,
    ShadowSettings,
    SplattingSettings,
    Surface,
    TileGrid,
    TileRasterizer,
    VisibleSurfaces,
)

SHADOWS = ShadowSettings(resolution=32)
# Tiles by the few: with the least optimization, a tenth of the time of the default.
TILED = RenderSettings(
    shadows=SHADOWS, sample_shadows=SHADOWS, rasterizer=TileRasterizer(lanes=8, slots=16)
)
# Plain renderers, which compile in a third of the time.
PLAIN = replace(TILED, rasterizer=DenseRasterizer(), diffuser=sj.diffusion.DenseDiffuser())


def unit(vectors) -> np.ndarray:
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def splats(centers, normals, radii, areas=None) -> sj.Splats:
    normals = unit(normals)
    radii = np.broadcast_to(np.asarray(radii, float), len(normals))
    areas = (radii / 1.5) ** 2 if areas is None else areas
    return sj.Splats(*(jnp.asarray(each, float) for each in (centers, normals, radii, areas)))


def directions(count: int, jitter: float = 0.35, seed: int = 0) -> np.ndarray:
    """Spread directions over the sphere; `jitter` in spacings."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    across = np.sqrt(1 - z * z)
    u = np.stack([np.cos(turn) * across, np.sin(turn) * across, z], 1)
    u += np.random.default_rng(seed).normal(size=u.shape) * jitter * np.sqrt(4 * np.pi / count)
    return unit(u)


def sphere(
    count: int, radius: float = 10.0, center=(0.0, 0.0, 0.0), jitter: float = 0.35, seed: int = 0
) -> sj.Splats:
    u = directions(count, jitter, seed)
    area = 4 * np.pi * radius**2 / count
    return splats(np.asarray(center) + radius * u, u, 1.5 * np.sqrt(area), np.full(count, area))


def bumpy(count: int, radius: float = 10.0, seed: int = 0) -> sj.Splats:
    """A closed body with bumps, its normals from the tangents of the surface."""

    def surface(u):
        bump = 0.08 * np.sin(4 * u[:, 0] + 1) * np.cos(3 * u[:, 1]) + 0.04 * np.sin(
            7 * u[:, 1] + 2 * u[:, 2]
        )
        return radius * u * (1 + bump)[:, None]

    u = directions(count, seed=seed)
    helper = np.where(np.abs(u[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    a = unit(np.cross(u, helper))
    step = 1e-5

    def tangent(t):
        return (surface(unit(u + step * t)) - surface(unit(u - step * t))) / (2 * step)

    normal = np.cross(tangent(a), tangent(np.cross(u, a)))
    density = np.linalg.norm(normal, axis=1)
    normal *= np.sign(np.sum(normal * u, axis=1))[:, None]
    areas = density * 4 * np.pi / count
    return splats(surface(u), normal, 1.5 * np.sqrt(areas), areas)


def with_albedo(body: sj.Splats, albedo) -> sj.Splats:
    albedo = jnp.asarray(albedo, float)
    return eqx.tree_at(lambda s: s.albedo, body, albedo, is_leaf=lambda leaf: leaf is None)


def joined(*bodies: sj.Splats) -> sj.Splats:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *bodies)


def sheet(
    half_width: float,
    spacing: float,
    normal=(0.0, 0.0, 1.0),
    center=(0.0, 0.0, 0.0),
    jitter: float = 0.0,
) -> sj.Splats:
    """A flat sheet of splats on a grid, off it by up to `jitter` in spacings."""
    normal = unit(normal)
    a = unit(np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0]))
    line = np.arange(-half_width, half_width + 1e-9, spacing)
    x, y = (each.reshape(-1, 1) for each in np.meshgrid(line, line))
    moves = spacing * np.random.default_rng(3).uniform(-jitter, jitter, (len(x), 3))
    moves = moves @ (np.eye(3) - np.outer(normal, normal))  # in the plane
    centers = np.asarray(center) + x * a + y * np.cross(normal, a) + moves
    return splats(centers, np.tile(normal, (len(x), 1)), 1.5 * spacing)


def perspective(
    eye=(0.0, 0.0, 40.0), target=(0.0, 0.0, 0.0), fov=35.0, width=40, height=32
) -> PerspectiveView:
    eye, target = (jnp.asarray(each, float) for each in (eye, target))
    return PerspectiveView.of(sj.Camera.look_at(eye, target, fov=fov, width=width, height=height))


def orthographic(scale=1.2, width=40, height=32) -> OrthographicView:
    """Look along a slanted axis at the origin."""
    forward = unit([0.2, -0.3, -1.0])
    right = unit(np.cross(forward, [0, 1.0, 0]))
    rotation = jnp.asarray(np.stack([right, np.cross(forward, right), forward]), float)
    return OrthographicView(jnp.zeros(3), rotation, jnp.asarray(scale, float), width, height)


def view(eye=(6.0, 4.0, 40.0), fov=32.0, size=20) -> sj.Camera:
    return sj.Camera.look_at(jnp.asarray(eye), jnp.zeros(3), fov=fov, width=size, height=size)


def lights_from_two_sides() -> list[sj.DirectionalLight]:
    ways = [-1.0, -0.4, -0.3], [0.8, -0.2, -0.6]
    return [sj.DirectionalLight(way, [2.0, 3.0], cast_shadows=False) for way in ways]


def irradiance(scene: sj.Scene, settings: RenderSettings = PLAIN) -> np.ndarray:
    """Compute the light that enters every splat: `[channels, splats]`."""
    plan = make_plan(scene, view(), settings)
    return np.asarray(compute_irradiance(scene, plan, settings).entering, float)


def camera_over(half_view: float, pixels: int, slant: float = 0.0) -> sj.Camera:
    """A camera far above the origin that sees `half_view` mm to each side; `slant` in degrees."""
    distance, angle = 40 * half_view, np.radians(slant)
    eye = [0.0, -distance * np.sin(angle), distance * np.cos(angle)]
    fov = 2 * np.degrees(np.arctan(1 / 40))
    return sj.Camera.look_at(eye, [0, 0, 0], fov=fov, width=pixels, height=pixels)


def hits(camera: sj.Camera) -> np.ndarray:
    """Where the rays through the pixels meet z = 0: `[height, width, 3]`."""
    y, x = np.indices((camera.height, camera.width)) + 0.5
    eye = np.asarray(camera.position, float)
    given = (jnp.asarray(each, float) for each in (x, y, np.full_like(x, np.linalg.norm(eye))))
    ways = np.moveaxis(np.asarray(PerspectiveView.of(camera).unproject(*given), float), 0, -1) - eye
    return eye - ways * (eye[2] / ways[..., 2:])


def map_directions(rows: int) -> np.ndarray:
    """The directions of the pixels as OpenEXR defines them."""
    polar = np.pi * (np.arange(rows)[:, None] + 0.5) / rows
    longitude = np.pi * (1 - (np.arange(2 * rows)[None] + 0.5) / rows)
    x, z = np.sin(polar) * np.sin(longitude), np.sin(polar) * np.cos(longitude)
    return np.stack(np.broadcast_arrays(x, np.cos(polar), z), axis=-1)


def two_gaussians() -> sj.SumOfGaussians:
    """A material of two layers, for laws that hold for any number: each more takes its time to
    compile.
    """
    return sj.SumOfGaussians([0.5, 3.0], [[0.3, 0.2, 0.1], [0.4, 0.3, 0.2]])


def apart(one, other) -> dict[str, float]:
    """Compute by how much the leaves of two trees differ, of the largest number in each; infinite
    numbers must be the same.
    """
    errors = {}
    leaves = zip(jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(other), strict=True)
    for (path, x), y in leaves:
        x, y = np.asarray(x), np.asarray(y)
        finite = np.isfinite(x)
        np.testing.assert_array_equal(finite, np.isfinite(y))
        largest = max(np.max(np.abs(x[finite]), initial=0.0), 1e-30)
        error = np.max(np.abs(x[finite] - y[finite]), initial=0.0) / largest
        errors[jax.tree_util.keystr(path)] = float(error)
    return errors


def assert_close(found, expected, **tolerance) -> None:
    """Compare two trees, leaf by leaf."""
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, **tolerance)


def assert_gradient(function: Callable, given: tuple, step: float, **tolerance) -> None:
    """Compare the gradient of a number, in one argument after the other, with central differences
    along some way.
    """
    value_and_gradient = jax.jit(jax.value_and_grad(function, argnums=range(len(given))))
    _, gradient = value_and_gradient(*given)
    for i, slope in enumerate(gradient):
        way = jnp.asarray(np.random.default_rng(i).normal(size=slope.shape), slope.dtype)
        moved = ((*given[:i], given[i] + by * way, *given[i + 1 :]) for by in (step, -step))
        ahead, behind = (value_and_gradient(*each)[0] for each in moved)
        expected = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(jnp.vdot(slope, way), expected, **tolerance)


def assert_refused(call: Callable[[], object], message: str) -> None:
    """Check that a call raises an error of bad input with a message, given as a pattern."""
    with pytest.raises(ValueError, match=message):
        call()


class Pictures(eqx.Module):
    """A surface as pictures: attributes in rows, depth in mm."""

    attributes: jax.Array
    depth: jax.Array
    weight_sum: jax.Array
    coverage: jax.Array


class Drawn(eqx.Module):
    """The surface in front and the one behind it, and the capacity needed over planned."""

    front: Pictures
    behind: Pictures
    needed: jax.Array


def drawn(
    body: sj.Splats,
    rows: jax.Array,
    view: AbstractView,
    settings: SplattingSettings,
    plan: AbstractRasterPlan,
) -> Drawn:
    """Draw both surfaces; where there is none all is 0, but the depth 1."""
    sums = plan.sum_fragments(body, rows, view, settings, DeviceMesh())
    grid, surface = TileGrid(view.width, view.height), Surface.of(sums.sums, view, sums.needed)
    share = VisibleSurfaces.of(sums, view, settings, DeviceMesh()).share
    planes = jnp.stack([surface.depth - 1, sums.sums.weights, share], 1)
    planes = jnp.concatenate([surface.attributes, planes], axis=1)

    def join(places: slice) -> Pictures:
        tiles = jnp.zeros((grid.count, *planes.shape[1:]), planes.dtype)
        joined = grid.join(tiles.at[sums.tiles[places]].set(planes[places], mode="drop"))
        return Pictures(joined[:-3], joined[-3] + 1, joined[-2], joined[-1])

    return Drawn(join(slice(sums.front)), join(slice(sums.front, None)), sums.needed)
