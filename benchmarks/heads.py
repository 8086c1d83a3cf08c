"""Heads as triangles with textures and as splats, for methods that need the one or the other."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines
from splatjax.geometry import Mesh, Textures, sample_mesh as sample_surface
from splatjax.io import read_textured_mesh

from .scenes import DISTANCE, FOCAL_LENGTH
from .yardstick import shared

MAP = 1024  # texels along an edge


class Body(NamedTuple):
    """A head in front of the camera, as triangles and as splats."""

    mesh: baselines.TexturedMesh
    splats: sj.Splats


def before_the_camera(mesh: Mesh) -> Mesh:
    """Turn a head that looks along +z towards the camera of `benchmarks.scenes`."""
    toward = np.asarray([1.0, -1.0, -1.0])
    corners = mesh.corners().reshape(-1, 3) * toward
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) - np.asarray([0.0, 0.0, DISTANCE])
    return Mesh(mesh.vertices * toward - middle, mesh.faces, mesh.normals * toward, mesh.uvs)


def scanned() -> tuple[Mesh, Textures]:
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
    return before_the_camera(mesh), textures


def bust() -> tuple[Mesh, Textures]:
    """Give the bust's head, its colors placed by its own coordinates."""
    mesh, textures = baselines.bust_with_textures(MAP)
    return before_the_camera(mesh), textures


HEADS = {"scanned": scanned, "bust": bust}


def body_of(head: str, count: int) -> Body:
    """Give one of the heads with so many splats."""
    mesh, textures = HEADS[head]()
    return Body(
        baselines.TexturedMesh.of(mesh, textures), sample_surface(mesh, count, textures=textures)
    )


def conditions(width: int) -> tuple[sj.DirectionalLight, sj.Camera]:
    """Give light and camera of `benchmarks.scenes`."""
    light = sj.DirectionalLight(jnp.asarray([0.5, 0.6, 0.65]), jnp.full(3, jnp.pi))
    return light, sj.Camera(jnp.zeros(3), jnp.eye(3), jnp.asarray(FOCAL_LENGTH), width, width)
