"""Brute-force integration over the surface of a mesh: what every way of spreading light should
give.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

import splatjax as sj
from splatjax import baselines
from splatjax.diffusion import AbstractDiffusionKernel

REACH = 5.5  # standard deviations; what lies beyond is 3e-7 of the power
LARGEST = 0.3  # mm: spacing of the samples of wide layers; textures have 0.45 mm to a texel
PER_DEVIATION = 4.0  # samples along a standard deviation of narrower ones
LEAST = 0.1  # mm: a layer narrower than that is the surface's own light
AT_ONCE = 1 << 20


class Samples(NamedTuple):
    """Points of the surface, what each stands for and what enters there."""

    positions: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    source: np.ndarray


class Truth(NamedTuple):
    """Means and kernel masses of every layer at points, as pass 4 has them."""

    means: np.ndarray
    mass: np.ndarray
    own: np.ndarray
    albedo: np.ndarray

    def layers(self, material: sj.Material, kernel: AbstractDiffusionKernel) -> np.ndarray:
        """Give `L_k` at the points, `[gaussians, points, channels]`."""
        gaussians = material.gaussians
        weights = np.asarray(gaussians.weights)[:, :, None] * self.albedo.T[None]
        given = (
            jnp.asarray(self.mass[:, None]),
            gaussians.variances,
            jnp.asarray(weights),
            jnp.zeros_like(self.albedo.T),
        )
        return self.means * np.asarray(kernel.gain(*given)).transpose(0, 2, 1)


def cut(pieces: int) -> np.ndarray:
    """Give the barycentric coordinates of the middles of the `pieces^2` equal triangles that a face
    is cut into.
    """
    i, j = (each.reshape(-1) for each in np.indices((pieces, pieces)))
    lower, upper = i + j < pieces, i + j < pieces - 1
    u = np.concatenate([i[lower] + 1 / 3, i[upper] + 2 / 3]) / pieces
    v = np.concatenate([j[lower] + 1 / 3, j[upper] + 2 / 3]) / pieces
    return np.stack([1 - u - v, u, v], axis=1)


@jax.jit
def _entering(mesh, light, material, faces, shares):
    points, _ = baselines.surface_points(mesh, faces, shares)
    albedo = jnp.ones_like(points.centers) if points.albedo is None else points.albedo
    return points.centers, points.normals, light.entering(points, material).source.T, albedo


def looked_at(mesh, light, material, faces: np.ndarray, shares: np.ndarray) -> list[np.ndarray]:
    """Give position, normal, what enters and albedo of points on faces."""
    parts = []
    for begin in range(0, len(faces), AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        few = AT_ONCE - len(faces[part])  # padded: one shape compiles once
        face, share = np.pad(faces[part], (0, few)), np.pad(shares[part], ((0, few), (0, 0)))
        given = jnp.asarray(face, jnp.int32), jnp.asarray(share, jnp.float32)
        parts.append(
            [np.asarray(each)[: AT_ONCE - few] for each in _entering(mesh, light, material, *given)]
        )
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def integrate(
    mesh: baselines.TexturedMesh,
    light: baselines.MeshLight,
    material: sj.Material,
    faces: np.ndarray,
    shares: np.ndarray,
    kernel: AbstractDiffusionKernel,
    refined: float = 1.0,
) -> Truth:
    """Integrate every layer at points on faces; `refined` more samples along each axis show whether
    they are enough.
    """
    points, _, own, albedo = looked_at(mesh, light, material, faces, shares)
    variances = np.asarray(material.gaussians.variances, np.float64)
    depths = np.asarray(kernel.depths(material.gaussians.variances), np.float64)
    widest = np.sqrt(variances.max())
    means, masses = [], []
    known: dict[float, Samples] = {}
    for variance, depth in zip(variances, depths, strict=True):
        deviation = np.sqrt(variance)
        if deviation < LEAST:
            means.append(own)
            masses.append(np.ones(len(own)))
            continue
        spacing = min(deviation / PER_DEVIATION, LARGEST) / refined
        if spacing not in known:
            reach = REACH * (deviation if spacing < LARGEST / refined else widest) + depths.max()
            known[spacing] = sampled(mesh, light, material, points, reach, spacing)
        samples = known[spacing]
        sunk = samples.positions - depth * samples.normals
        mean, mass = np.zeros_like(own), np.zeros(len(own))
        tree = cKDTree(sunk)
        for i, point in enumerate(
            points
        ):  # one by one: all their neighbors together would fill the memory
            found = tree.query_ball_point(point, REACH * deviation)
            squared = np.sum((sunk[found] - point) ** 2, axis=1)
            weight = samples.areas[found] * np.exp(-0.5 * squared / variance)
            gathered = weight.sum()
            mean[i] = weight @ samples.source[found] / gathered
            mass[i] = gathered * np.exp(0.5 * depth**2 / variance) / (2 * np.pi * variance)
        means.append(mean)
        masses.append(mass)
    return Truth(np.stack(means), np.stack(masses), own, albedo)


def sampled(mesh, light, material, points: np.ndarray, reach: float, spacing: float) -> Samples:
    """Sample the surface within reach of points; a sample stands for `spacing^2` at most."""
    corners = np.asarray(mesh.corners(), np.float64)
    around, middles = cKDTree(points), corners.mean(axis=1)
    extents = np.max(np.linalg.norm(corners - middles[:, None], axis=2), axis=1)
    near = np.flatnonzero(around.query(middles)[0] < reach + extents)
    doubled = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    longest = np.max(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), axis=1)
    pieces = np.ceil(np.maximum(np.sqrt(0.5 * doubled), 0.6 * longest)[near] / spacing).astype(int)
    faces, shares, areas = [], [], []
    for each in np.unique(pieces):
        shape = cut(each)
        for few in np.array_split(
            near[pieces == each], -(-np.sum(pieces == each) * each**2 // AT_ONCE)
        ):
            places = np.einsum("sc,fci->fsi", shape, corners[few])
            inside = np.isfinite(around.query(places, distance_upper_bound=reach, workers=-1)[0])
            face, share = np.nonzero(inside)
            faces.append(few[face])
            shares.append(shape[share])
            areas.append(0.5 * doubled[few[face]] / each**2)
    positions, normals, source, _ = looked_at(
        mesh, light, material, np.concatenate(faces), np.concatenate(shares)
    )
    return Samples(positions, normals, np.concatenate(areas), source)
