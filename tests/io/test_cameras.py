"""Cameras and lights of files that other programs wrote: pycolmap 4.2.1 and pygltflib 1.16.5
(tests/io/cameras). Cameras show points where those programs do.
"""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
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


def with_z_up(vectors):
    return np.asarray(vectors)[..., [0, 2, 1]] * [1, -1, 1]


@pytest.fixture
def transforms(tmp_path):
    """The first image of COLMAP as colmap2nerf.py of instant-ngp writes it: camera to world, with
    the columns of down and forward reversed.
    """
    cameras = load_cameras(FILES / "colmap", mm_per_unit=1.0)
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(cameras["left 1.png"].rotation, float).T * [1, -1, -1]
    pose[:3, 3] = cameras["left 1.png"].position
    content = {"w": 640, "h": 480.0, "fl_x": 600.5, "fl_y": 600.5, "cx": 310.25, "cy": 251.5}
    content |= {"k1": 0.0, "p2": 0, "is_fisheye": False, "camera_angle_x": 9.0, "aabb_scale": 4}
    content["frames"] = [{"file_path": "left 1.png", "transform_matrix": pose.tolist()}]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    return path, content


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_cameras_of_colmap_show_what_colmap_shows(double, tmp_path, suffix):
    for name in ("cameras", "images"):
        data = (FILES / "colmap" / f"{name}.{suffix}").read_bytes()
        (tmp_path / f"{name}.{suffix}").write_bytes(data)
    cameras = load_cameras(tmp_path, mm_per_unit=MM)
    assert list(cameras) == list(COLMAP)
    for name, expected in COLMAP.items():
        np.testing.assert_allclose(pixels(cameras[name], POINTS), expected, atol=PIXELS)
    tall = cameras["tall.png"]
    assert (tall.width, tall.height, tall.principal_point) == (100, 200, None)
    turned = load_cameras(tmp_path / f"images.{suffix}", mm_per_unit=MM, up="z")["left 1.png"]
    upright = POINTS[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(pixels(turned, upright), COLMAP["left 1.png"], atol=PIXELS)


def test_cameras_of_nerf_have_the_axes_of_opengl(double, transforms):
    path, content = transforms
    camera = load_cameras(path, mm_per_unit=MM)["left 1.png"]
    np.testing.assert_allclose(pixels(camera, POINTS), COLMAP["left 1.png"], atol=PIXELS)
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del content[name]
    content["camera_angle_x"] = 2 * np.arctan(320 / 600.5)
    path.write_text(json.dumps(content))
    sj.write_png(path.with_name("left 1.png"), np.zeros((480, 640, 1)))
    camera = load_cameras(path, mm_per_unit=MM)["left 1.png"]
    expected = np.asarray(COLMAP["left 1.png"]) - [310.25 - 320, 251.5 - 240]
    np.testing.assert_allclose(pixels(camera, POINTS), expected, atol=PIXELS)


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_cameras_of_gltf_have_its_projection(double, suffix):
    """Against the infinite projection matrix of the specification, with the node's matrices
    multiplied out.
    """
    with pytest.warns(UserWarning, match="'plan' is orthographic"):
        cameras = load_cameras(FILES / f"stage.{suffix}", mm_per_unit=MM)
    assert list(cameras) == ["left", "right"]
    root = 0.5**0.5
    rig = np.asarray([[root, 0, root], [0, 1, 0], [-root, 0, root]])
    w, x, y, z = np.asarray([4, 1, 2, 3]) / 30**0.5
    left = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    right = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    places = {"left": ([0.5, 0.0, 2.0], left, 0.7, 1.5), "right": ([1.5, 0.25, 0.5], right, 0.9, 1)}
    for name, (offset, axes, yfov, aspect) in places.items():
        eye = [0.1, 0.2, -0.3] + rig @ (2 * np.asarray(offset))
        points = eye + [[0.3, -0.2, -3.0], [-0.4, 0.1, -2.0]] @ (rig @ np.asarray(axes)).T
        depth = np.asarray([3.0, 2.0])
        clip = np.asarray([[0.3, -0.2], [-0.4, 0.1]]) / [
            aspect * np.tan(yfov / 2),
            np.tan(yfov / 2),
        ]
        size = np.asarray([round(512 * aspect), 512])
        expected = (clip / depth[:, None] * [1, -1] + 1) / 2 * size
        np.testing.assert_allclose(pixels(cameras[name], points), expected, atol=PIXELS)


def test_lights_of_gltf_keep_what_a_surface_receives(double):
    """In lux: a directional light anywhere, others at a unit of length."""
    with pytest.warns(UserWarning, match="'beamer' is a spot"):
        sun, bulb, spot = load_lights(FILES / "stage.gltf", mm_per_unit=MM, lux=0.5)
    np.testing.assert_allclose(sun.irradiance, [1.5, 0.75, 0.375])
    root = 0.5**0.5
    np.testing.assert_allclose(sun.direction / jnp.linalg.norm(sun.direction), [0, 1, 0], atol=1e-9)
    place = np.asarray([0.1, 0.2, -0.3]) + 2 * np.asarray([4 * root, 2, 2 * root])
    np.testing.assert_allclose(bulb.position, MM * place)
    wi, received = bulb.incidence(bulb.position + jnp.asarray([0, -MM, 0]))
    np.testing.assert_allclose(received, [10, 9, 8])
    np.testing.assert_allclose(wi, [0, 1, 0])
    assert isinstance(spot, sj.PointLight)


CHANGES = [
    ({"k1": 0.1}, "k1 = 0.1"),
    ({"is_fisheye": True}, "is_fisheye"),
    ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
    ({"fl_y": 590.0}, "fl_y is 590"),
    ({"fl_x": -1.0, "fl_y": -1.0}, "focal_length"),
    ({"fl_x": None}, "transforms.json"),
    ({"w": None}, "transforms.json"),
    ({"frames": []}, "no perspective camera"),
    ({"frames": [{"transform_matrix": np.diag([1.0, 2, 1, 1]).tolist()}]}, "sheared"),
    ({"frames": [{"transform_matrix": np.diag([1.0, -1, 1, 1]).tolist()}]}, "mirrored"),
    ({"frames": [{"transform_matrix": [[1, 2]]}]}, "transforms.json"),
]


@pytest.mark.parametrize(("changes", "value"), CHANGES)
def test_cameras_that_cannot_be_ours(transforms, changes, value):
    path, content = transforms
    path.write_text(json.dumps(content | changes))
    with pytest.raises(ValueError, match=value) as caught:
        load_cameras(path, mm_per_unit=1.0)
    assert str(path) in str(caught.value)


def test_files_without_cameras_name_the_remedy(tmp_path, transforms):
    path, content = transforms
    path.write_text(json.dumps({name: content[name] for name in content if name not in "wh"}))
    with pytest.raises(ValueError, match="add w and h"):
        load_cameras(path, mm_per_unit=1.0)
    with pytest.raises(FileNotFoundError, match=r"cameras\.bin"):
        load_cameras(tmp_path, mm_per_unit=1.0)
    text = (FILES / "colmap" / "cameras.txt").read_text().replace("SIMPLE_PINHOLE", "FOV")
    (tmp_path / "cameras.txt").write_text(text)
    (tmp_path / "images.txt").write_text((FILES / "colmap" / "images.txt").read_text())
    with pytest.raises(ValueError, match=r"FOV.*undistort"):
        load_cameras(tmp_path, mm_per_unit=1.0)
    with pytest.raises(ValueError, match="not a file of cameras"):
        load_cameras(tmp_path / "cameras.txt", mm_per_unit=1.0)
    (tmp_path / "empty.gltf").write_text("{}")
    for read in (load_cameras, load_lights):
        with pytest.raises(ValueError, match=r"empty\.gltf: has no .*export"):
            read(tmp_path / "empty.gltf", mm_per_unit=1.0)
        with pytest.raises(ValueError, match="mm_per_unit is 0"):
            read(tmp_path / "empty.gltf", mm_per_unit=0.0)
    (tmp_path / "circle.gltf").write_text(
        '{"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}'
    )
    with pytest.raises(ValueError, match=r"circle\.gltf.*child"):
        load_cameras(tmp_path / "circle.gltf", mm_per_unit=1.0)
