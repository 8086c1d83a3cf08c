"""Small files under the names that pages use for a reader's own; and what reference pages take for
granted, small. Pages that teach stand for themselves.
"""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import trimesh
from jax.sharding import NamedSharding, PartitionSpec
from pictures import write_picture
from PIL import Image

import splatjax as sj
from splatjax.cli import main

_RADIUS = 1.1  # of the ball, in units of 53 mm
_SIDE = 24  # pixels
_TESTS = Path(__file__).parents[1]
_TRANSFORMS = """{"w": 64, "h": 64, "fl_x": 80, "frames": [{"file_path": "images/0001.png",
"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 30], [0, 0, 0, 1]]}]}"""
_SCENE = """material = "marble"
splats = { bust = 1500 }
camera = { position = [0, 0, 600], target = [0, 0, 0], width = 32, height = 32 }
lights = [{ kind = "point", position = [0, 0, 600], intensity = 1e6 }]
"""


def _ball() -> trimesh.Trimesh:
    ball = trimesh.creation.uv_sphere(radius=_RADIUS, count=(24, 32))
    x, y, z = ball.vertices.T / _RADIUS
    uv = np.stack(
        [np.arctan2(x, z) / (2 * np.pi) + 0.5, np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5], axis=-1
    )
    ball.visual = trimesh.visual.TextureVisuals(uv=uv)
    return ball


def _splats(path: Path) -> None:
    mesh = path.with_name("ball.glb")
    _ball().export(mesh)
    splats = sj.sample_mesh(mesh, 1500, mm_per_unit=53.0)
    mesh.unlink()
    sj.write_splats(path, dataclasses.replace(splats, albedo=jnp.full((1500, 3), 0.8)))


def _points(path: Path) -> None:
    points = trimesh.sample.sample_surface_even(_ball(), 1200, seed=0)[0] * 53
    trimesh.PointCloud(points).export(path)


def _map(path: Path) -> None:
    flat = (128, 128, 255) if "normal" in path.name else (200, 150, 130)
    Image.new("RGB", (16, 16), flat).save(path)


def _measured(path: Path) -> None:
    radii = np.linspace(0.5, 10, 20)
    rows = np.column_stack([radii, sj.Dipole(sj.load_medium("marble"))(radii)])
    np.savetxt(path, rows, delimiter=",", header="radius (mm), red, green, blue")


def _dot(path: Path) -> None:
    y, x = (np.mgrid[:120, :120] - 59.5) * 0.1
    gaussians = sj.load_material("marble").gaussians
    write_picture(path, np.asarray(gaussians(jnp.hypot(x, y)), np.float64) * 5 / np.pi)


def _marble(splats: sj.Splats, specular: float, **view) -> np.ndarray:
    """Render marble as howto/recover.md lists its pictures."""
    material = dataclasses.replace(sj.load_material("marble"), specular=specular)
    lamp = sj.DirectionalLight([1, -0.3, -0.5], 3.14)
    scene = sj.Scene(dataclasses.replace(splats, albedo=None), lamp, material)
    camera = sj.Camera.look_at(**view, width=_SIDE, height=_SIDE)
    return np.asarray(sj.render(scene, camera).beauty)


def _photograph(path: Path) -> None:
    splats = sj.read_splats(path.with_name("head.ply"))
    write_picture(path, _marble(splats, specular=0.0, eye=[0, 0, 500], target=[0, -20, 0], fov=25))


def _figurine(path: Path) -> None:
    splats = sj.bust(1_500).scaled(0.2)
    sj.write_splats(path, dataclasses.replace(splats, albedo=None))
    picture = _marble(splats, specular=0.18, eye=[0, 0, 130], target=[0, -8, 0], fov=30)
    write_picture(path.with_suffix(".exr"), picture)


_MADE = {
    "head.ply": _splats,
    "head_40000.ply": _splats,
    "cloud.ply": _splats,
    "head.glb": lambda path: _ball().export(path),
    "points.ply": _points,
    "color.jpg": _map,
    "freckles.png": _map,
    "melanin.png": _map,
    "albedo.jpg": _map,
    "shine.jpg": _map,
    "normals.jpg": _map,
    "normal.jpg": _map,
    "measured.csv": _measured,
    "dot.exr": _dot,
    "left.exr": _photograph,
    "figurine.ply": _figurine,
    "transforms.json": lambda path: path.write_text(_TRANSFORMS),
    "stage.glb": lambda path: shutil.copy(_TESTS / "io" / "cameras" / "stage.glb", path),
    "scene.toml": lambda path: path.write_text(_SCENE),
}


def lay_out(folder: Path, text: str) -> None:
    """Write into a folder what a text names and does not make itself."""
    for name, make in _MADE.items():
        if name in text:
            make(folder / name)


def lay_out_frame(folder: Path, text: str) -> None:
    """Write the picture that a page's programs read and its commands would have made."""
    if "head.exr" in text:
        _splats(folder / "head.ply")
        options = ["--width", "32", "--height", "32", "--light-elevation", "30"]
        output = ["--output", str(folder / "head.exr")]
        assert main(["render", str(folder / "head.ply"), *options, *output]) == 0


WITH_CONTEXT = {
    f"docs/{name}.md"
    for name in ("devices", "gradients", "figures", "baselines", "recovery", "fit_scene")
}


def context() -> dict[str, Any]:
    splats = sj.bust(900).scaled(1 / 8).without_maps()
    camera = sj.Camera.look_at([8, 0, 70], [0, -3.5, 0], fov=32.0, width=_SIDE, height=_SIDE)
    lights = (sj.DirectionalLight([-1, -0.3, -0.4], jnp.full(3, jnp.pi)),)
    scene = sj.Scene(splats, lights, dataclasses.replace(sj.load_material("marble"), specular=0.0))
    plan = sj.make_plan(scene, camera)
    picture = np.asarray(sj.render(scene, camera, plan=plan).beauty)
    return {
        "jax": jax,
        "jnp": jnp,
        "np": np,
        "optax": optax,
        "sj": sj,
        "splatjax": sj,
        "NamedSharding": NamedSharding,
        "PartitionSpec": PartitionSpec,
        "splats": splats,
        "camera": camera,
        "cameras": jax.tree.map(lambda leaf: jnp.stack([leaf] * jax.device_count()), camera),
        "lights": lights,
        "medium": sj.load_medium("marble"),
        "material": scene.material,
        "scene": scene,
        "plan": plan,
        "picture": picture,
        "noise": np.full(picture.shape, 0.01 * float(np.sqrt(np.mean(picture**2)))),
        "target": jnp.zeros((_SIDE, _SIDE, 3)),
    }
