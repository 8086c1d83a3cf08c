"""Sheets and spheres whose pictures are known."""

import jax.numpy as jnp
import numpy as np

import splatjax as sj

SKIN_VARIANCES = (0.0064, 0.0484, 0.187, 0.567, 1.99, 7.41)
SKIN_WEIGHTS = (
    (0.233, 0.455, 0.649),
    (0.100, 0.336, 0.344),
    (0.118, 0.198, 0.0),
    (0.113, 0.007, 0.007),
    (0.358, 0.004, 0.0),
    (0.078, 0.0, 0.0),
)


def skin() -> sj.SumOfGaussians:
    """The six-Gaussian skin of d'Eon and Luebke (GPU Gems 3, chapter 14)."""
    return sj.SumOfGaussians(jnp.asarray(SKIN_VARIANCES, float), jnp.asarray(SKIN_WEIGHTS, float))


def two_gaussians() -> sj.SumOfGaussians:
    """A material of two layers, for laws that hold for any number: each more takes its time to
    compile.
    """
    return sj.SumOfGaussians(
        jnp.asarray([0.5, 3.0], float), jnp.asarray([[0.3, 0.2, 0.1], [0.4, 0.3, 0.2]], float)
    )


def sheet(spacing: float, half_width: float, kind: str = "grid") -> sj.Splats:
    """A flat sheet at z = 0 that faces +z; a splat at the origin. Areas are exact but for
    `jittered`, where they are the mean.
    """
    count = round(half_width / spacing)
    line = np.arange(-count, count + 1) * spacing
    x, y = (each.reshape(-1) for each in np.meshgrid(line, line))
    areas = np.full(x.size, spacing * spacing)
    if kind == "jittered":
        jitter = np.random.default_rng(7).uniform(-0.25, 0.25, (2, x.size)) * spacing
        jitter[:, x.size // 2] = 0
        x, y = x + jitter[0], y + jitter[1]
        areas = voronoi_areas(np.stack([x, y], 1), spacing, half_width)
    if kind == "graded":
        # u -> x(u) with dx/du rising smoothly from 0.4 to 1.6: areas 4:1 from left to right, exact
        # by the map's Jacobian
        u, y = (
            each.reshape(-1)
            for each in np.meshgrid(np.arange(-3 * count, 3 * count + 1) * spacing, line)
        )
        stretch = 0.3 * half_width
        x = u + 0.6 * stretch * np.log(np.cosh(u / stretch))
        areas = spacing * spacing * (1 + 0.6 * np.tanh(u / stretch))
        inside = np.abs(x) <= half_width
        x, y, areas = x[inside], y[inside], areas[inside]
    centers = np.stack([x, y, np.zeros_like(x)], 1)
    normals = np.tile([0.0, 0.0, 1.0], (x.size, 1))
    radii = 1.5 * np.sqrt(areas)
    return sj.Splats(*(jnp.asarray(each, float) for each in (centers, normals, radii, areas)))


def voronoi_areas(points: np.ndarray, spacing: float, half_width: float) -> np.ndarray:
    """Exact areas of the Voronoi cells inside the sheet; cells at the border are given the
    grid's.
    """
    from scipy.spatial import Voronoi

    diagram = Voronoi(points)
    areas = np.full(len(points), spacing * spacing)
    for i, region in enumerate(diagram.point_region):
        corners = diagram.regions[region]
        if -1 in corners or np.max(np.abs(points[i])) > half_width - 2 * spacing:
            continue
        polygon = diagram.vertices[corners]
        x, y = polygon.T
        areas[i] = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    return areas


def camera_over(half_view: float, pixels: int, slant: float = 0.0) -> sj.Camera:
    """A camera far above the origin that sees `half_view` mm to each side; `slant` in degrees."""
    distance = 40 * half_view
    angle = np.radians(slant)
    eye = jnp.asarray([0.0, -distance * np.sin(angle), distance * np.cos(angle)], float)
    fov = float(2 * np.degrees(np.arctan(half_view / distance)))
    return sj.Camera.look_at(eye, jnp.zeros(3), fov=fov, width=pixels, height=pixels)


def sphere(count: int, radius: float = 50.0) -> sj.Splats:
    """A sphere, evenly covered."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (1 + 5**0.5) * i
    across = np.sqrt(1 - z * z)
    normals = np.stack([np.cos(turn) * across, np.sin(turn) * across, z], 1)
    areas = np.full(count, 4 * np.pi * radius**2 / count)
    arrays = (radius * normals, normals, 1.5 * np.sqrt(areas), areas)
    return sj.Splats(*(jnp.asarray(each, float) for each in arrays))
