"""Common parts of glTF and USD, in meters: the body as triangles, and the poses of lights and
cameras.
"""

import numpy as np
from jaxtyping import Float

from splatjax.geometry import Mesh, tangent_frames, unit
from splatjax.scene import AbstractLight, Camera, EnvironmentLight, RectangleLight, Splats

METERS = 1e-3  # per mm
_CORNERS = 6  # corners of the polygon that replaces a disc


def body_mesh(splats: Splats, mesh: Mesh | None) -> Mesh:
    """Return the body as triangles: a hexagon per splat, or the given mesh with the albedo of the
    nearest splat at each vertex.
    """
    from scipy.spatial import KDTree  # takes a third of a second

    centers, normals = np.asarray(splats.centers, float), np.asarray(splats.normals, float)
    if mesh is not None:
        vertices, faces, vertex_normals = mesh.vertices, mesh.faces, mesh.normals
        nearest = KDTree(centers).query(vertices)[1]
    else:
        across, along = (axis[:, None] for axis in tangent_frames(unit(normals)))
        turns = 2 * np.pi * np.arange(_CORNERS)[:, None] / _CORNERS
        rim = np.cos(turns) * across + np.sin(turns) * along
        radii = np.asarray(splats.radii, float)[:, None, None]
        vertices = np.reshape(centers[:, None] + radii * rim, (-1, 3))
        nearest = np.repeat(np.arange(len(centers)), _CORNERS)
        fan = np.asarray([[0, k, k + 1] for k in range(1, _CORNERS - 1)])
        faces = np.reshape(_CORNERS * np.arange(len(centers))[:, None, None] + fan, (-1, 3))
        vertex_normals = normals[nearest]
    albedo = None if splats.albedo is None else np.asarray(splats.albedo, float)[nearest]
    if albedo is not None:
        albedo = np.broadcast_to(albedo, (len(vertices), 3))
    return Mesh(METERS * vertices, faces, vertex_normals, colors=albedo)


def camera_pose(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Compute the transformation from the axes of a camera (right, up and back) to the world."""
    axes = np.asarray(camera.rotation, float) * np.asarray([1, -1, -1])[:, None]
    return _pose(axes, camera.position)


def light_pose(light: AbstractLight) -> Float[np.ndarray, "4 4"]:
    """Compute the transformation to the world from the axes of a light that shines along -z, or of
    the image of an environment.
    """
    if isinstance(light, RectangleLight):
        along, across = unit(np.asarray(light.edges, float))
        axes = np.stack([across, along, np.cross(across, along)])
    elif isinstance(light, EnvironmentLight):
        axes = np.asarray(light.to_world(), float).T
    else:
        forward = getattr(light, "direction", (0.0, 0.0, -1.0))
        back = -unit(np.asarray(forward, float)[None])
        axes = np.concatenate([*tangent_frames(back), back])
    return _pose(axes, getattr(light, "position", getattr(light, "center", np.zeros(3))))


def strength(light: AbstractLight) -> tuple[float, list[float]]:
    """Return the strength of a light in its brightest channel, and its color relative to that."""
    values = np.broadcast_to(np.asarray(getattr(light, light.strength_field), float), 3)
    greatest = float(values.max())
    return greatest, (values / (greatest or 1.0)).tolist()


def _pose(axes: np.ndarray, place) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes.T, METERS * np.asarray(place, float)
    return pose
