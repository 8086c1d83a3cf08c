"""Small files under the names that pages use for a reader's own."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import OpenEXR
import trimesh
from PIL import Image

import splatjax as sj

_RADIUS = 1.1  # of the ball, in units of 53 mm
_SIDE = 24  # pixels


def _ball() -> trimesh.Trimesh:
    ball = trimesh.creation.uv_sphere(radius=_RADIUS, count=(24, 32))
    x, y, z = ball.vertices.T / _RADIUS
    uv = np.stack(
        [np.arctan2(x, z) / (2 * np.pi) + 0.5, np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5], axis=-1
    )
    ball.visual = trimesh.visual.TextureVisuals(uv=uv)
    return ball


def _mesh(path: Path) -> None:
    _ball().export(path)


def _splats(path: Path) -> None:
    mesh = path.with_name("ball.glb")
    _mesh(mesh)
    splats = sj.sample_mesh(mesh, 1500, mm_per_unit=53.0)
    mesh.unlink()
    sj.write_splats(
        path,
        sj.Splats(
            splats.centers, splats.normals, splats.radii, splats.areas, jnp.full((1500, 3), 0.8)
        ),
    )


def _points(path: Path) -> None:
    points = trimesh.sample.sample_surface_even(_ball(), 1200, seed=0)[0] * 53
    rows = "\n".join("{:.4f} {:.4f} {:.4f}".format(*point) for point in points)
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float "
        "x\nproperty float y\nproperty float z\nend_header\n"
    )
    path.write_text(f"{header}{rows}\n", encoding="utf-8")


def _map(path: Path) -> None:
    flat = (128, 128, 255) if "normal" in path.name else (200, 150, 130)
    Image.new("RGB", (16, 16), flat).save(path)


def _measured(path: Path) -> None:
    radii = np.linspace(0.5, 10, 20)
    values = np.asarray(sj.Dipole(sj.load_medium("marble"))(jnp.asarray(radii)), np.float64)
    np.savetxt(
        path,
        np.column_stack([radii, values]),
        delimiter=",",
        header="radius (mm), red, green, blue",
    )


def _exr(path: Path, picture: np.ndarray) -> None:
    planes = {
        name: np.ascontiguousarray(picture[..., k], np.float32) for k, name in enumerate("RGB")
    }
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, planes) as file:
        file.write(str(path))


def _dot(path: Path) -> None:
    y, x = (np.mgrid[:120, :120] - 59.5) * 0.1
    _exr(
        path,
        np.asarray(sj.load_material("marble").gaussians(jnp.hypot(x, y)), np.float64) * 5 / np.pi,
    )


def _photograph(path: Path) -> None:
    """As pictures.toml of howto/recover.md has it, of marble."""
    splats = _read_plain(path.with_name("head.ply"))
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 0.0, 500.0]),
        jnp.asarray([0.0, -20.0, 0.0]),
        fov=25.0,
        width=_SIDE,
        height=_SIDE,
    )
    lamp = sj.DirectionalLight(jnp.asarray([1.0, -0.3, -0.5]), jnp.full(3, 3.14))
    marble = sj.load_material("marble")
    material = sj.Material(marble.gaussians, eta=marble.eta, specular=0.0)
    _exr(path, np.asarray(sj.render(sj.Scene(splats, (lamp,), material), camera).beauty))


def _figurine(path: Path) -> None:
    """As howto/recover.md makes it, of marble; and its picture."""
    bust = sj.bust(1_500)
    splats = sj.Splats(0.2 * bust.centers, bust.normals, 0.2 * bust.radii, 0.04 * bust.areas)
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 0.0, 130.0]),
        jnp.asarray([0.0, -8.0, 0.0]),
        fov=30.0,
        width=_SIDE,
        height=_SIDE,
    )
    lamp = sj.DirectionalLight(jnp.asarray([1.0, -0.3, -0.5]), jnp.full(3, 3.14))
    sj.write_splats(path, splats)
    sj.write_exr(
        path.with_suffix(".exr"),
        sj.render(sj.Scene(splats, (lamp,), sj.load_material("marble")), camera),
    )


def _read_plain(path: Path) -> sj.Splats:
    splats = sj.read_splats(path)
    return sj.Splats(splats.centers, splats.normals, splats.radii, splats.areas)


def _frame(path: Path) -> None:
    from splatjax.cli import main

    assert (
        main(
            [
                "render",
                str(path.with_name("head.ply")),
                "--width",
                "32",
                "--height",
                "32",
                "--output",
                str(path),
            ]
        )
        == 0
    )


_MADE = {
    "head.ply": _splats,
    "head_40000.ply": _splats,
    "cloud.ply": _splats,
    "head.glb": _mesh,
    "points.ply": _points,
    "color.jpg": _map,
    "albedo.jpg": _map,
    "shine.jpg": _map,
    "normals.jpg": _map,
    "normal.jpg": _map,
    "measured.csv": _measured,
    "dot.exr": _dot,
    "left.exr": _photograph,
    "figurine.ply": _figurine,
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
        _frame(folder / "head.exr")
