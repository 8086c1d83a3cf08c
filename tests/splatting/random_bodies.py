"""Small random scenes of one shape, the first of each sequence of one kind alone: what goes wrong
goes wrong at some of these.

A scene of a seed is always the same. Each is drawn where a view sees it: `x` and `y` in pixels,
depth in mm, so that every kind is met whatever the view.
"""

import os

import bodies
import jax.numpy as jnp
import numpy as np

import splatjax as sj

KINDS = (
    "plain",
    "larger than the picture",
    "tiny",
    "behind",
    "off screen",
    "at the border",
    "edge on",
    "nearly edge on",
    "facing away",
    "through the near plane",
    "in one tile",
    "in one place",
    "two sheets",
    "alone",
    "none is seen",
)
NEAR = 1e-2
ALL = int(os.environ.get("SPLATJAX_RANDOM_SCENES", "0"))


def seeds(in_suite: int) -> range:
    """Seeds of the scenes to try: some dozens in the suite, a twentieth of SPLATJAX_RANDOM_SCENES
    where that is more.
    """
    return range(max(in_suite, ALL // 20))


def sight(
    rng: np.random.Generator, perspective: bool, width: int, height: int
) -> sj.splatting.AbstractView:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation[2] *= np.linalg.det(rotation)
    focal_length = height / (2 * np.tan(np.radians(rng.uniform(10, 50))))  # in pixels
    scale = rng.uniform(0.4, 2.5)  # in pixels per mm
    given = rng.normal(size=3) * 10, rotation, focal_length if perspective else scale
    given = (jnp.asarray(each, float) for each in given)
    if perspective:
        return sj.splatting.PerspectiveView(*given, width, height, NEAR)
    return sj.splatting.OrthographicView(*given, width, height)


def random_body(
    seed: int, count: int, perspective: bool, width: int, height: int
) -> tuple[sj.Splats, sj.splatting.AbstractView]:
    rng = np.random.default_rng([seed, count, perspective])
    seen = sight(rng, perspective, width, height)
    kinds = (
        [KINDS[seed]]
        if seed < len(KINDS)
        else list(rng.choice(KINDS[:-2], rng.integers(1, 5), replace=False))
    )
    parts = [_drawn(str(kind), rng, count, seen) for kind in kinds]
    which = rng.integers(0, len(parts), count)
    places, normals, radii = (
        np.stack(each)[which, np.arange(count)] for each in zip(*parts, strict=True)
    )
    areas = (radii / 1.5) ** 2 * rng.uniform(0.5, 2, count)
    return bodies.splats(places, normals, radii, areas), seen


def disagreement(found, expected) -> float:
    """Give the largest error, each relative to what is expected there and to what is typical: the
    median of all that is not 0.

    So a number that is far larger than the others hides nothing. NaN where anything is.
    """
    found, expected = np.asarray(found), np.asarray(expected)
    size = np.abs(expected)
    typical = np.median(size[size > 0]) if np.any(size > 0) else 1.0
    return float(np.max(np.abs(found - expected) / (size + typical), initial=0.0))


def _drawn(kind: str, rng: np.random.Generator, count: int, seen: sj.splatting.AbstractView):
    width, height, perspective = (
        seen.width,
        seen.height,
        isinstance(seen, sj.splatting.PerspectiveView),
    )
    pixels = float(seen.focal_length if perspective else seen.scale)
    x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
    depth = np.exp(rng.uniform(np.log(4.0), np.log(rng.choice([5.0, 40.0])), count))
    size = np.exp(rng.uniform(np.log(0.6), np.log(6.0), count))  # radius in pixels
    steepest = rng.choice([0.3, 1.0, 5.0])
    match kind:
        case "larger than the picture":
            size = np.exp(rng.uniform(0, 3, count)) * width
        case "tiny":
            size = 10 ** rng.uniform(-3, -0.5, count)
        case "behind":
            depth = -depth
        case "off screen" | "none is seen":
            away = rng.uniform(1, 40, count) * width
            x = np.where(rng.uniform(size=count) < 0.5, -away, width + away)
            if kind == "off screen":  # some reach into the picture
                keeps_size = rng.uniform(size=count) < 0.5
                size = np.where(keeps_size, size, away * rng.uniform(0.8, 2.0, count))
        case "at the border":
            x = rng.choice([0.0, width], count) + rng.uniform(-1.5, 1.5, count) * size
        case "through the near plane":
            depth = NEAR * np.exp(rng.uniform(-1, 5, count))
            size = np.exp(rng.uniform(0, 6, count))
        case "in one tile":
            x, y = rng.uniform(8.2, 15.8, (2, count))
            size = rng.uniform(0.3, 2, count)
        case "in one place":
            x, y, depth = (np.repeat(each[:1], count) for each in (x, y, depth))
        case "two sheets":
            depth, size = np.full(count, depth[0]), rng.uniform(2, 6, count)
    mm = depth / pixels if perspective else np.full_like(depth, 1 / pixels)  # of a pixel
    across = np.stack([x - width / 2, y - height / 2]) * mm
    position, axes = np.asarray(seen.position, float), np.asarray(seen.rotation, float)
    places = np.stack([*across, depth], axis=1) @ axes
    distance = np.linalg.norm(places, axis=1, keepdims=True)
    rays = places / distance if perspective else np.tile(axes[2], (count, 1))
    places += position
    across = bodies.unit(np.cross(rays, rng.normal(size=(count, 3))))
    slope = np.abs(rng.normal(size=count)) * steepest
    if kind == "in one place" and rng.uniform() < 0.5:
        across, slope, size = (np.repeat(each[:1], count, axis=0) for each in (across, slope, size))
    normals = -rays + slope[:, None] * across
    match kind:
        case "facing away":
            normals = -normals
        case "edge on":
            normals = across
        case "nearly edge on":
            slant = rng.choice([-1, 1], count) * 10 ** rng.uniform(-9, -1, count)
            normals = across - rays * slant[:, None]
    normals, radii = bodies.unit(normals), size * np.abs(mm)
    match kind:
        case "two sheets":
            settings = sj.splatting.SplattingSettings()
            radii = np.full(count, radii[0])
            normals = -rays
            reach = np.hypot(radii, settings.filter_radius * mm)
            apart = settings.epsilon_z * reach * rng.choice([0.5, 0.97, 1.03, 2.5])
            places += np.where(np.arange(count) % 2, apart, 0)[:, None] * rays
        case "alone":
            hidden = np.arange(count) != rng.integers(count)
            normals = np.where(hidden[:, None], rays, normals)
    return places, normals, radii
