"""Heads as triangles with textures and as splats, for methods that need the one or the other."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import rivals
from splatjax.geometry import Mesh, Textures, bust_mesh, cut_below, sample_mesh as sample_surface
from splatjax.geometry._complexion import complexion
from splatjax.io import read_textured_mesh

from .scenes import DISTANCE, FOCAL_LENGTH
from .yardstick import shared

MAP = 1024  # texels along an edge


class Body(NamedTuple):
    """A head in front of the camera, as triangles and as splats."""

    mesh: rivals.TexturedMesh
    splats: sj.Splats


def before_the_camera(mesh: Mesh) -> Mesh:
    """Turn a head that looks along +z towards the camera of `benchmarks.scenes`."""
    toward = np.asarray([1.0, -1.0, -1.0])
    corners = mesh.corners().reshape(-1, 3) * toward
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) - np.asarray([0.0, 0.0, DISTANCE])
    return Mesh(mesh.vertices * toward - middle, mesh.faces, mesh.normals * toward, mesh.uvs)


def scanned(count: int) -> Body:
    """Give the scanned head with its maps."""
    folder = shared() / "data" / "lee_perry_smith"
    mesh, textures = read_textured_mesh(
        folder / "LeePerrySmith.glb",
        mm_per_unit=53,
        v_up=True,
        crop_min_y=-0.9,
        albedo=folder / "Map-COL.jpg",
        specular=folder / "Map-SPEC.jpg",
        normal=folder / "Infinite-Level_02_Tangent_SmoothUV.jpg",
    )
    return _body(before_the_camera(mesh), textures, count)


def bust(count: int) -> Body:
    """Give the bust's head, its colors laid out by its own coordinates: longitude and latitude, seen from inside."""
    mesh = cut_below(bust_mesh(), -105.0)
    assert mesh.uvs is not None
    low, high = mesh.uvs.min(axis=(0, 1)), mesh.uvs.max(axis=(0, 1))
    mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, 0.002 + 0.996 * (mesh.uvs - low) / (high - low))
    bare = rivals.TexturedMesh.of(mesh)
    texels = rivals.lay_out(bare, MAP, rivals.room_for(rivals.Landing.in_texture(bare.uvs, MAP)))
    points = np.asarray(texels.points.centers, np.float64)
    albedo, specular, roughness = (each.reshape(MAP, MAP, *each.shape[1:]) for each in complexion(points))
    return _body(before_the_camera(mesh), Textures(albedo, specular, roughness), count)


def _body(mesh: Mesh, textures: Textures, count: int) -> Body:
    return Body(rivals.TexturedMesh.of(mesh, textures), sample_surface(mesh, count, textures=textures))


def conditions(width: int) -> tuple[sj.DirectionalLight, sj.Camera]:
    """Give light and camera of `benchmarks.scenes`."""
    light = sj.DirectionalLight(jnp.asarray([0.5, 0.6, 0.65]), jnp.full(3, jnp.pi))
    return light, sj.Camera(jnp.zeros(3), jnp.eye(3), jnp.asarray(FOCAL_LENGTH), width, width)


HEADS = {"scanned": scanned, "bust": bust}
