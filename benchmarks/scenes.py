"""What is rendered: heads and a thin sheet, under one light with a shadow map."""

import jax.numpy as jnp
import numpy as np

import splatjax as sj

from .yardstick import make_scene, shared

FOCAL_LENGTH = 2.6  # in heights of the picture; the camera is at the origin and looks along +z
DISTANCE = 600.0  # of the middle of a head, mm
SKIN = (0.0064, 0.0484, 0.187, 0.567, 1.99, 7.41)  # mm^2
_SCAN = "data/lee_perry_smith"


BODIES = ("synthetic", "scanned", "sheet")
MATERIALS = ("skin", "marble")


def columns(body: str, splats: int) -> dict[str, np.ndarray]:
    """Give the prototype's head, the scanned head or a thin sheet: p, n, r, col, area, irr, as the
    yardstick reads them.
    """
    return {"synthetic": make_scene, "scanned": scanned, "sheet": sheet}[body](splats)


def sheet(splats: int) -> dict[str, np.ndarray]:
    """Give a wavy sheet 1 mm thick, 160 mm along an edge: two faces, as thin as an ear's rim, seen
    at a slant.
    """
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-80, 80, (2, splats))
    side = np.where(np.arange(splats) % 2 == 0, 1.0, -1.0)
    height, slope = 6 * np.sin(u / 12) * np.cos(v / 17), 0.5 * np.cos(u / 12) * np.cos(v / 17)
    other = -6 / 17 * np.sin(u / 12) * np.sin(v / 17)
    normals = np.stack([-slope, -other, np.ones(splats)], axis=1)
    stretch = np.linalg.norm(normals, axis=1)
    normals *= (side / stretch)[:, None]
    turn = np.asarray([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    centers = (np.stack([u, v, height], axis=1) + 0.5 * normals) @ turn.T + np.asarray(
        [0.0, 0.0, DISTANCE]
    )
    areas = stretch * 160**2 / (splats / 2)
    columns = {
        "p": centers,
        "n": normals @ turn.T,
        "r": 1.5 * np.sqrt(areas),
        "col": np.clip(0.7 + 0.2 * np.sin(centers * 0.2), 0, 1),
        "area": areas,
        "irr": np.ones((splats, 3)),
    }
    return {name: values.astype(np.float32) for name, values in columns.items()}


def scanned(splats: int) -> dict[str, np.ndarray]:
    """Sample the scanned head with its maps, and turn it toward the camera."""
    folder = shared() / _SCAN
    maps = {
        "albedo": folder / "Map-COL.jpg",
        "specular": folder / "Map-SPEC.jpg",
        "normal": folder / "Infinite-Level_02_Tangent_SmoothUV.jpg",
    }
    # on the triangles, as others draw them
    found = sj.sample_mesh(
        folder / "LeePerrySmith.glb",
        splats,
        mm_per_unit=53,
        v_up=True,
        crop_min_y=-0.9,
        rounded=False,
        **maps,
    )
    toward = np.asarray([1.0, -1.0, -1.0], np.float32)  # the file has y up and looks along +z
    centers = np.asarray(found.centers) * toward
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    return {
        "p": centers - middle + np.asarray([0.0, 0.0, DISTANCE], np.float32),
        "n": np.asarray(found.normals) * toward,
        "r": np.asarray(found.radii),
        "col": np.asarray(found.albedo),
        "area": np.asarray(found.areas),
        "irr": np.ones((splats, 3), np.float32),
    }


def lit(
    data: dict[str, np.ndarray], width: int, material: str = "skin"
) -> tuple[sj.Scene, sj.Camera]:
    """Give scene and camera of a square picture."""
    array = {name: jnp.asarray(values) for name, values in data.items()}
    splats = sj.Splats(array["p"], array["n"], array["r"], array["area"], array["col"])
    skin = sj.Material(
        sj.SumOfGaussians(jnp.asarray(SKIN), jnp.full((len(SKIN), 3), 1 / len(SKIN)))
    )
    light = sj.DirectionalLight(jnp.asarray([0.5, 0.6, 0.65]), jnp.full(3, jnp.pi))
    camera = sj.Camera(jnp.zeros(3), jnp.eye(3), jnp.asarray(FOCAL_LENGTH), width, width)
    return sj.Scene(
        splats, (light,), skin if material == "skin" else sj.load_material(material)
    ), camera
