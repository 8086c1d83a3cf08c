"""A flat plane whose chart is stretched, and what it is painted with."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj

# mm, from the middle to the edges.
HALF = 12.0


def plane(stretch: float, quads: int = 6, half: float = HALF) -> sj.geometry.Mesh:
    """A square at z = 0 that faces +z; `stretch` times as many mm along u as along v, its chart in
    the middle of the texture.
    """
    line, step = np.linspace(-half, half, quads + 1), quads + 1
    vertices = np.stack(np.meshgrid(line, line, 0.0), axis=-1).reshape(-1, 3)
    first = np.arange(step * step).reshape(step, step)[:-1, :-1].reshape(-1)
    corners = [0, 1, step + 1], [0, step + 1, step]
    faces = np.concatenate([np.add.outer(first, each) for each in corners])
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return sj.geometry.Mesh(vertices, faces, normals, coordinates(vertices, stretch, half)[faces])


def coordinates(points: np.ndarray, stretch: float, half: float = HALF) -> np.ndarray:
    return 0.5 + 0.45 * points[:, :2] / half / np.asarray([stretch, 1.0])


def spots(points: np.ndarray) -> np.ndarray:
    """Albedo of a plane with soft-edged spots and bars of several colors, some as small as the
    layers are wide.
    """
    x, y = points[:, 0], points[:, 1]
    fine = 0.5 + 0.5 * np.tanh(3 * np.sin(1.6 * x) * np.sin(1.3 * y + 0.4))
    bars = 0.5 + 0.5 * np.tanh(4 * np.sin(0.9 * x + 0.3 * y))
    disc = 0.5 - 0.5 * np.tanh(2 * (np.hypot(x - 1, y + 2) - 3))
    return 0.1 + 0.85 * np.stack([fine, bars, disc], axis=1)


def painted(stretch: float, size: int) -> sj.geometry.Textures:
    row, column = np.indices((size, size)).reshape(2, -1)
    uvs = np.stack([(column + 0.5) / size, 1 - (row + 0.5) / size], axis=1)
    points = (uvs - 0.5) / 0.45 * HALF * np.asarray([stretch, 1.0])
    return sj.geometry.Textures(albedo=spots(points).reshape(size, size, 3))


def splatted(points: np.ndarray, gaussians: sj.SumOfGaussians, spacing: float = 0.3) -> np.ndarray:
    """The layers of the plane by splat diffusion, unlit but for its paint: `[gaussians, points,
    channels]`.
    """
    body = bodies.sheet(HALF - spacing / 2, spacing)
    light = jnp.asarray(np.sqrt(spots(np.asarray(body.centers))).T, float)
    sources = sj.diffusion.Sources(body.centers.T, body.normals.T, body.areas, light)
    means, _ = gathered(sources, gaussians.variances, sj.diffusion.PlainMean(), points)
    return means.transpose(0, 2, 1)


@eqx.filter_jit
def gathered(
    sources: sj.diffusion.Sources,
    variances,
    kernel: sj.diffusion.AbstractDiffusionKernel,
    points: np.ndarray,
) -> tuple[jax.Array, jax.Array]:
    places = jnp.asarray(points.T, float)
    layers = [
        sj.diffusion.dense_layer(sources, places, variance, depth)
        for variance, depth in zip(variances, kernel.depths(variances), strict=True)
    ]
    values = jnp.stack([each.values for each in layers])
    return values[:, :-1], values[:, -1]
