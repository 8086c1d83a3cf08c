"""Cameras and lights of files that other programs wrote: pycolmap 4.2.1 and pygltflib 1.16.5
(tests/io/cameras). Cameras show points where those programs do.
"""

import json
import shutil
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from bodies import unit
from scipy.spatial.transform import Rotation
from test_refusals import refused, write_any

from splatjax.io import load_cameras, load_lights
from splatjax.splatting import PerspectiveView

FILES = Path(__file__).parent / "cameras"
PIXELS = 1e-4
POINTS = np.asarray(
    [
        [0.8861122111447353, 0.022655105628723193, 0.9524874114154083],
        [-0.8383279522087956, 0.21471166399005925, -0.24702683124545488],
    ]
)
# `Image.project_point` of pycolmap, of both points.
COLMAP = {
    "left 1.png": [[375.86381318254905, 109.43660808941749], [305.58760782723397, 331.0859795334]],
    "b/right.png": [[366.68781047829805, 103.13323678695804], [268.49248770965113, 296.828151725]],
    "tall.png": [[46.582191831827224, 96.82077812563418], [63.915072691285516, 85.99365168608837]],
}
MM = 20.0  # of the unit of the files


def pixels(camera, points, mm=MM):
    """Project points of a file, which have +y up."""
    x, y, _ = PerspectiveView.of(camera).project(jnp.asarray(mm * np.asarray(points).T))
    return np.stack([x, y], axis=-1)


in_mm = partial(load_cameras, mm_per_unit=1.0)


@pytest.fixture
def transforms(tmp_path):
    """The first image of COLMAP as colmap2nerf.py of instant-ngp writes it: camera to world, with
    the columns of down and forward reversed.
    """
    camera = load_cameras(FILES / "colmap", mm_per_unit=1.0)["left 1.png"]
    pose = np.eye(4)
    pose[:3] = np.column_stack([np.asarray(camera.rotation).T * [1, -1, -1], camera.position])
    content = {"w": 640, "h": 480.0, "fl_x": 600.5, "fl_y": 600.5, "cx": 310.25, "cy": 251.5}
    content |= {"k1": 0.0, "p2": 0, "is_fisheye": False, "aabb_scale": 4}
    content["frames"] = [{"file_path": "left 1.png", "transform_matrix": pose.tolist()}]

    def write(removed="", **changes):
        text = json.dumps(
            {n: v for n, v in (content | changes).items() if n not in removed.split()}
        )
        return write_any(tmp_path / "transforms.json", text)

    return write


@pytest.mark.parametrize("folder", ["colmap", "colmap_binary"])
def test_cameras_of_colmap_show_what_colmap_shows(double, folder):
    cameras = load_cameras(FILES / folder, mm_per_unit=MM)
    assert list(cameras) == list(COLMAP)
    for name, expected in COLMAP.items():
        np.testing.assert_allclose(pixels(cameras[name], POINTS), expected, atol=PIXELS)
    tall = cameras["tall.png"]
    assert (tall.width, tall.height, tall.principal_point) == (100, 200, None)
    turned = load_cameras(FILES / folder, mm_per_unit=MM, up="z")["left 1.png"]
    upright = POINTS[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(pixels(turned, upright), COLMAP["left 1.png"], atol=PIXELS)


def test_cameras_of_nerf_have_the_axes_of_opengl(double, transforms):
    camera = load_cameras(transforms(), mm_per_unit=MM)["left 1.png"]
    np.testing.assert_allclose(pixels(camera, POINTS), COLMAP["left 1.png"], atol=PIXELS)
    half = transforms("fl_x fl_y cx cy", camera_angle_x=2 * np.arctan(320 / 600.5))
    camera = load_cameras(half, mm_per_unit=MM)["left 1.png"]
    expected = np.asarray(COLMAP["left 1.png"]) - [310.25 - 320, 251.5 - 240]
    np.testing.assert_allclose(pixels(camera, POINTS), expected, atol=PIXELS)


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_cameras_of_gltf_have_its_projection(double, suffix):
    """Against the projection matrix of the specification, with the matrices of the nodes."""
    with pytest.warns(UserWarning, match="'plan' is orthographic"):
        cameras = load_cameras(FILES / f"stage.{suffix}", mm_per_unit=MM)
    rig = Rotation.from_rotvec([0, np.pi / 4, 0])
    left, right = Rotation.from_quat([1, 2, 3, 4]), Rotation.from_rotvec([0, np.pi / 2, 0])
    lenses = {"left": ([0.5, 0, 2], left, 0.7, 1.5), "right": ([1.5, 0.25, 0.5], right, 0.9, 1)}
    for (name, camera), (place, turn, yfov, aspect) in zip(
        cameras.items(), lenses.values(), strict=True
    ):
        near = np.asarray([[0.3, -0.2, -3.0], [-0.4, 0.1, -2.0]])
        world = np.asarray([0.1, 0.2, -0.3]) + rig.apply(2 * np.asarray(place) + turn.apply(near))
        device = near[:, :2] / (np.tan(yfov / 2) * np.asarray([aspect, 1])) / -near[:, 2:]
        expected = (device * [1, -1] + 1) / 2 * np.asarray([512 * aspect, 512])
        np.testing.assert_allclose(pixels(camera, world), expected, atol=PIXELS, err_msg=name)


def test_lights_of_gltf_keep_what_a_surface_receives(double):
    """In lux: a directional light anywhere, others at a unit of length."""
    sun, bulb, spot = load_lights(FILES / "stage.gltf", mm_per_unit=MM, lux=0.5)
    np.testing.assert_allclose(sun.irradiance, [1.5, 0.75, 0.375])
    np.testing.assert_allclose(unit(sun.direction), [0, 1, 0], atol=1e-9)
    place = np.asarray([0.1, 0.2, -0.3]) + Rotation.from_rotvec([0, np.pi / 4, 0]).apply([2, 4, 6])
    np.testing.assert_allclose(bulb.position, MM * place)
    _, received = bulb.incidence(bulb.position + jnp.asarray([0, -MM, 0]))
    np.testing.assert_allclose(received, [10, 9, 8])
    axis = Rotation.from_rotvec([0, np.pi / 4, 0]).apply([0, 0, -1])
    np.testing.assert_allclose(unit(spot.direction), axis, atol=1e-9)
    np.testing.assert_allclose([spot.inner_angle, spot.outer_angle], [0, np.degrees(0.5)])
    _, received = spot.incidence(spot.position[None] + MM * jnp.asarray([axis, -axis]))
    np.testing.assert_allclose(received, [[2.5] * 3, [0] * 3])


FOV = "1 FOV 640 480 600.5 310.25 251.5 0.9\n7 PINHOLE 100 200 150 150 50 100\n"
STRETCHED, MIRRORED = ([{"transform_matrix": np.diag([1.0, n, 1, 1]).tolist()}] for n in (2, -1))


@pytest.mark.parametrize(
    ("changes", "value"),
    [
        ({"k1": 0.1}, "k1 = 0.1"),
        ({"is_fisheye": True}, "is_fisheye"),
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"fl_y": 590.0}, "fl_y is 590"),
        ({"fl_x": -1.0, "fl_y": -1.0}, "focal_length"),
        ({"fl_x": None}, "transforms.json"),
        ({"removed": "w h"}, "add w, h"),
        ({"frames": []}, "no perspective camera"),
        ({"frames": STRETCHED}, "sheared"),
        ({"frames": MIRRORED}, "mirrored"),
        ({"frames": [{"transform_matrix": [[1, 2]]}]}, "transforms.json"),
    ],
)
def test_cameras_that_cannot_be_ours(transforms, changes, value):
    refused(transforms(**changes), value, read=in_mm)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("cameras.txt", FOV, "not a file of cameras"),
        ("none.json", None, "no such file"),
        ("circle.gltf", '{"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}', "Recursion"),
        ("empty.gltf", '{"scenes": [{}]}', "export it with its cameras"),
    ],
)
def test_files_without_cameras(tmp_path, name, text, value):
    path = tmp_path / name
    if text:
        write_any(path, text)
    refused(path, value, in_mm, (ValueError, OSError))


def test_a_lens_of_colmap_with_distortion(tmp_path):
    shutil.copy(FILES / "colmap" / "images.txt", tmp_path)
    refused(write_any(tmp_path / "cameras.txt", FOV), "FOV", lambda path: in_mm(path.parent))
    folder = shutil.copytree(FILES / "colmap_binary", tmp_path / "binary")
    data = bytearray((folder / "cameras.bin").read_bytes())
    data[12] = 5  # OPENCV_FISHEYE
    (folder / "cameras.bin").write_bytes(data)
    refused(folder / "cameras.bin", "model 5", lambda path: in_mm(path.parent))


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_a_truncated_file_of_colmap(tmp_path, name):
    folder = shutil.copytree(FILES / "colmap_binary", tmp_path / "binary")
    (folder / name).write_bytes((folder / name).read_bytes()[:-5])
    refused(folder, "truncated", in_mm)
