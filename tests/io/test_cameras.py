"""Scenes as TOML files and manifests of pictures; cameras and lights of files that other programs
wrote: pycolmap 4.2.1 and pygltflib 1.16.5 (tests/io/cameras). Cameras show points where those
programs do.
"""

import json
import shutil
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from bodies import assert_refused, unit
from PIL import Image
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation
from test_refusals import refused, write_any
from writers import export, some_frame, some_splats, square

import splatjax as sj
from splatjax.io import (
    load_cameras,
    load_lights,
    load_scene,
    mesh_of_scene,
    save_scene,
    save_usd,
    scene_table,
)
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
TRANSFORMS = """{"w": 640, "h": 480.0, "fl_x": 600.5, "fl_y": 600.5, "cx": 310.25, "cy": 251.5,
"k1": 0.0, "p2": 0, "is_fisheye": false, "aabb_scale": 4}"""


@pytest.fixture
def transforms(tmp_path):
    """The first image of COLMAP as colmap2nerf.py of instant-ngp writes it: camera to world, with
    the columns of down and forward reversed.
    """
    camera = in_mm(FILES / "colmap")["left 1.png"]
    pose = np.eye(4)
    pose[:3] = np.column_stack([np.asarray(camera.rotation).T * [1, -1, -1], camera.position])
    content = json.loads(TRANSFORMS)
    content["frames"] = [{"file_path": "left 1.png", "transform_matrix": pose.tolist()}]

    def write(removed="", **changes):
        kept = {n: v for n, v in (content | changes).items() if n not in removed.split()}
        return write_any(tmp_path / "transforms.json", json.dumps(kept))

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
    centered = transforms("fl_x fl_y cx cy", camera_angle_x=2 * np.arctan(320 / 600.5))
    camera = load_cameras(centered, mm_per_unit=MM)["left 1.png"]
    expected = np.asarray(COLMAP["left 1.png"]) - [310.25 - 320, 251.5 - 240]
    np.testing.assert_allclose(pixels(camera, POINTS), expected, atol=PIXELS)


RIG = Rotation.from_rotvec([0, np.pi / 4, 0])


def to_world(points):
    return np.asarray([0.1, 0.2, -0.3]) + RIG.apply(points)


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_cameras_of_gltf_have_its_projection(double, suffix):
    """Against the projection matrix of the specification, with the matrices of the nodes."""
    with pytest.warns(UserWarning, match="'plan' is orthographic"):
        cameras = load_cameras(FILES / f"stage.{suffix}", mm_per_unit=MM)
    left, right = Rotation.from_quat([1, 2, 3, 4]), Rotation.from_rotvec([0, np.pi / 2, 0])
    lenses = {"left": ([0.5, 0, 2], left, 0.7, 1.5), "right": ([1.5, 0.25, 0.5], right, 0.9, 1)}
    near = np.asarray([[0.3, -0.2, -3.0], [-0.4, 0.1, -2.0]])
    for (name, camera), (place, turn, yfov, aspect) in zip(
        cameras.items(), lenses.values(), strict=True
    ):
        world = to_world(2 * np.asarray(place) + turn.apply(near))
        device = near[:, :2] / (np.tan(yfov / 2) * np.asarray([aspect, 1])) / -near[:, 2:]
        expected = (device * [1, -1] + 1) / 2 * np.asarray([512 * aspect, 512])
        np.testing.assert_allclose(pixels(camera, world), expected, atol=PIXELS, err_msg=name)


def test_lights_of_gltf_keep_what_a_surface_receives(double):
    """In lux: a directional light anywhere, others at a unit of length."""
    sun, bulb, spot = load_lights(FILES / "stage.gltf", mm_per_unit=MM, lux=0.5)
    np.testing.assert_allclose(sun.irradiance, [1.5, 0.75, 0.375])
    np.testing.assert_allclose(unit(sun.direction), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(bulb.position, MM * to_world([2, 4, 6]))
    _, received = bulb.incidence(bulb.position + jnp.asarray([0, -MM, 0]))
    np.testing.assert_allclose(received, [10, 9, 8])
    axis = RIG.apply([0, 0, -1])
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
        ({"frames": [{"transform_matrix": (np.inf * np.ones((4, 4))).tolist()}]}, "finite"),
    ],
)
def test_cameras_that_cannot_be_ours(transforms, changes, value):
    refused(transforms(**changes), value, read=in_mm)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("cameras.txt", FOV, "not a file of cameras"),
        ("circle.gltf", '{"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}', "Recursion"),
        ("empty.gltf", '{"scenes": [{}]}', "export it with its cameras"),
    ],
)
def test_files_without_cameras(tmp_path, name, text, value):
    refused(write_any(tmp_path / name, text), value, in_mm)
    refused(tmp_path / "none.json", "no such file", in_mm, OSError)


@pytest.mark.parametrize(
    ("folder", "name", "change", "value"),
    [
        ("colmap", "cameras.txt", lambda data: FOV.encode(), "FOV"),
        # OPENCV_FISHEYE
        ("colmap_binary", "cameras.bin", lambda data: data[:12] + b"\5" + data[13:], "model 5"),
        ("colmap_binary", "cameras.bin", lambda data: data[:-5], "truncated"),
        ("colmap_binary", "images.bin", lambda data: data[:-5], "truncated"),
    ],
)
def test_files_of_colmap_with_distortion_or_cut_short(tmp_path, folder, name, change, value):
    path = shutil.copytree(FILES / folder, tmp_path / folder) / name
    path.write_bytes(change(path.read_bytes()))
    refused(path, value, lambda path: in_mm(path.parent))


CAMERA = sj.Camera.look_at([0, 0, 90], [0, 1, 0], fov=30, width=20, height=16)
CLOSE = {"rtol": 1e-6, "atol": 1e-7}
SHAPE = sj.RenderSettings(bounces=1, diffuser=sj.diffusion.ShapeDiffuser())
BY_HAND = """material = "marble"
[splats]
mesh = "body/box.stl"
count = 60
mm_per_unit = 10
up = "z"
[camera]
file = "cameras/colmap"
name = "left 1.png"
mm_per_unit = 2
height = 240
[[lights]]
kind = "environment"
image = "overcast"
rotation = 20
"""


BODY, FILE = BY_HAND[BY_HAND.index("mesh") :].split("\n[camera]\n")
FILE = FILE[: FILE.index("height")]
SPOT = 'kind = "spot"\nposition = [9, 9, 9]\nintensity = 1\ntarget = '


def test_a_scene_comes_back_from_its_file_and_from_a_manifest(tmp_path):
    """With every light; in single precision for splats and environments."""
    lights = (
        sj.DirectionalLight([1, -1, 0], [3, 2, 1], cast_shadows=False),
        sj.PointLight([50, 60, 70], [1e4, 2e4, 3e4]),
        sj.scene.SpotLight([50, 60, 70], [0, 0, -1], [1e4, 2e4, 3e4], 10, 25),
        sj.GaussianBeam([0, 0, 90], [0, 0, -1], [5, 6, 7], 4.0),
        sj.scene.RectangleLight([90, 0, 0], [1, 2, 3], [[0, 9, 0], [0, 0, 9]], count=7),
        sj.scene.DiskLight([90, 0, 0], [1, 2, 3], [-1, 0, 0], 5.0),
        sj.scene.SphereLight([90, 0, 0], [1, 2, 3], 5.0),
        *(
            sj.EnvironmentLight(
                np.random.default_rng(0).uniform(size=(4, 8, 3)), 30, [1, 2, 3], directions=given
            )
            for given in (None, sj.scene.even_directions(5))
        ),
    )
    scene = sj.Scene(some_splats(), lights, sj.load_material("marble"))
    camera = replace(CAMERA, principal_point=[0.4, 0.6], near=0.5)
    save_scene(tmp_path / "a.toml", scene, camera, SHAPE)
    manifest = {"scene": tomllib.loads((tmp_path / "a.toml").read_text())}
    sj.write_exr(tmp_path / "a.exr", some_frame(), manifest=manifest)
    for path in (tmp_path / "a.toml", tmp_path / "a.exr"):
        assert eqx.tree_equal(load_scene(path), (scene, camera, SHAPE), **CLOSE)
    for diffuser in (sj.diffusion.ExitanceDiffuser(), sj.diffusion.ClusterDiffuser()):
        save_scene(tmp_path / "b.toml", scene, camera, sj.RenderSettings(diffuser=diffuser), g=0.25)
        assert load_scene(tmp_path / "b.toml")[2].diffuser == diffuser
    material = sj.io.material_of_scene(sj.io.scene_table(tmp_path / "b.toml"))
    assert sj.io.load_mean_cosine(material) == 0.25
    plain = replace(SHAPE, kernel=sj.diffusion.PlainMean())
    write = partial(save_scene, tmp_path / "a.toml")
    assert_refused(partial(write, scene, camera, plain), r"a\.toml: stores only bounces")
    for light, value in (
        (sj.scene.HarmonicLight(np.zeros((9, 3))), "cannot store a HarmonicLight"),
        (sj.EnvironmentLight(np.zeros((4, 8, 5)), strength=np.ones(5)), r"a\.toml: .* 5 channels"),
    ):
        assert_refused(partial(write, replace(scene, lights=light), camera), value)
    save_scene(tmp_path / "dark.toml", replace(scene, lights=()), camera)
    assert load_scene(tmp_path / "dark.toml")[0].lights == ()


@pytest.fixture
def by_hand(tmp_path):
    (tmp_path / "body").mkdir()
    (tmp_path / "cameras").symlink_to(FILES)
    trimesh.creation.box((1, 1, 9)).export(tmp_path / "body" / "box.stl")
    return write_any(tmp_path / "a.toml", BY_HAND)


def test_a_scene_by_hand_names_files_beside_it(by_hand):
    scene, camera, settings = load_scene(by_hand)
    assert scene.splats.count == 60
    assert np.ptp(np.asarray(scene.splats.centers), axis=0).argmax() == 1
    sky = sj.EnvironmentLight(sj.scene.overcast_sky(), 20, [1, 1, 1])
    expected = sj.load_material("marble"), (sky,), sj.RenderSettings()
    assert eqx.tree_equal((scene.material, scene.lights, settings), expected)
    cameras = partial(load_cameras, by_hand.with_name("cameras") / "colmap")
    expected = replace(cameras(mm_per_unit=2.0)["left 1.png"], width=320, height=240)
    assert eqx.tree_equal(camera, expected, **CLOSE)
    text = BY_HAND.replace("height = 240", 'up = "z"').replace("count", "scale = 0.5\ncount")
    _, camera, _ = load_scene(write_any(by_hand, text.replace('"marble"', '"marble_gems"')))
    assert eqx.tree_equal(camera, cameras(mm_per_unit=1.0, up="z")["left 1.png"], **CLOSE)
    near = text.replace(FILE, "near = 60\nposition = [0, 0, 90]\ntarget = [0, 1, 0]\n")
    assert load_scene(write_any(by_hand, near.replace('up = "z"\n[[', "[[")))[1].near == 60


def test_a_mesh_of_a_scene_has_maps(by_hand):
    """The map, red above blue, is the color of the splats and of the exported mesh."""
    export(square(), by_hand.parent, "obj")
    Image.fromarray(np.uint8([[[255, 0, 0]]] * 8 + [[[0, 0, 255]]] * 8)).save(
        by_hand.with_name("map.png")
    )
    text = BY_HAND.replace("body/box.stl", "a.obj").replace('"z"', '"y"\nalbedo = "map.png"')
    for more, above in (("", 0), ("\nv_up = false", 2)):
        write_any(by_hand, text.replace("[camera]", f"{more}\n[camera]"))
        scene, camera, _ = load_scene(by_hand)
        heights = np.asarray(scene.splats.centers)[:, 1]
        colors = np.asarray(scene.splats.albedo)[(heights > 12) & (heights < 19)]
        np.testing.assert_allclose(colors[:, above], 1.0, atol=1e-3)
        mesh = mesh_of_scene(scene_table(by_hand))
        save_usd(exported := by_hand.with_name(f"{above}.usda"), scene, camera, mesh=mesh)
        stage = Usd.Stage.Open(str(exported))
        body = UsdGeom.Mesh.Get(stage, "/scene/body")
        heights = np.asarray(body.GetPointsAttr().Get())[:, 1]
        colors = np.asarray(body.GetDisplayColorAttr().Get())[heights > heights.mean()]
        assert np.all(colors[:, above] > 0.5)


AIMED = """[[lights]]
kind = "rectangle"
center = [-60, 50, 60]
target = [0, 5, 0]
width = 30
height = 40
radiance = 2
[[lights]]
kind = "disk"
center = [1, 2, 3]
target = [0, 5, 0]
radius = 4
radiance = 3
[[lights]]
kind = "spot"
position = [1, 2, 3]
target = [0, 5, 0]
intensity = 3
[[lights]]
kind = "environment"
image = "overcast"
directions = 9
"""


def test_lights_may_face_a_target(by_hand, tmp_path):
    before, _ = BY_HAND.split("[[lights]]")
    scene, *others = load_scene(write_any(by_hand, before + AIMED))
    facing = sj.scene.RectangleLight.facing
    assert eqx.tree_equal(
        scene.lights,
        (
            facing([-60, 50, 60], [0, 5, 0], 30, 40, [2, 2, 2]),
            sj.scene.DiskLight([1, 2, 3], [3, 3, 3], [-1, 3, -3], 4),
            sj.scene.SpotLight([1, 2, 3], [-1, 3, -3], [3, 3, 3]),
            sj.EnvironmentLight(
                sj.scene.overcast_sky(),
                0,
                [1, 1, 1],
                directions=sj.scene.even_directions(9),
            ),
        ),
    )
    save_scene(tmp_path / "saved.toml", scene, *others)
    assert "directions = 9\n" in (tmp_path / "saved.toml").read_text()
    path = write_any(by_hand, before + AIMED.replace("radius", "direction = [0, 0, 1]\nradius"))
    refused(path, "unknown entry 'direction'", load_scene)


@pytest.mark.parametrize(
    ("before", "after", "value"),
    [
        ('"marble"', '"marbel"', "'marble'"),
        ('"marble"', "5", "[material] must be a table"),
        ("mesh", "meshes", "[splats] has an unknown entry 'meshes'"),
        ('"body/box.stl"', "5", "[splats] mesh must be a name in quotes; it is 5"),
        ("box.stl", "none.stl", "none.stl: there is no such file"),
        ('"body/box.stl"', '"none.stl"', "[splats]: "),
        ("mm_per_unit = 10", "", "[splats] mm_per_unit"),
        ("count = 60", "count = 60\nscale = true", "[splats] scale"),
        ('"left 1.png"', '"7"', "has no camera '7'; give one of its 3 names"),
        (FILE, "position = [0, 0, 9]\n", "[camera] rotation"),
        ('"overcast"', '"fog.exr"', "fog.exr"),
        ("[[lights]]", "[settings]\nbounces = -1\n[[lights]]", "[settings]"),
        ("[[lights]]", '[settings]\ndiffusion = "dipole"\n[[lights]]', "diffusion must be"),
        ("count = 60", "count = 60\nalbedo = 1", "albedo must be true or false; it is 1"),
        ("count = 60", 'count = 60\nnormal = "none.png"', "none.png"),
        ("mesh =", "file =", "[splats] has an unknown entry 'count'"),
        ("mesh =", "bust = 60\nmesh =", "[splats] has an unknown entry 'count'"),
        (BODY, 'bust = 60\nup = "z"', "[splats] up must be 'y'; it is 'z'"),
        (BODY, 'bust = 60\nalbedo = "a.png"', "[splats] albedo must be true or false"),
        ("count = 60", "count = 60.9", "[splats] count must be a whole number; it is 60.9"),
        ("count = 60", "count = inf", "[splats] count must be a whole number; it is inf"),
        ("height = 240", "height = 24.5", "[camera] height must be a whole number; it is 24.5"),
        ("count = 60", "count = 60\nscale = -1", "[splats]: the scale must be positive; got -1"),
        ("height = 240", "fov = 30", "[camera] has an unknown entry 'fov'"),
        ("[[lights]]", "[settings]\nbounces = 0.9\n[[lights]]", "bounces must be a whole number"),
        ("[[lights]]", f"[[lights]]\n{SPOT}[1, 2]\n[[lights]]", "target must be three numbers"),
        ('"overcast"', '"overcst"', "did you mean 'overcast'"),
        (FILE, "position = [0, 9]\ntarget = 0\n", "position must be"),
        ("[[lights]]", "[lights]", "lights must be one table or more"),
    ],
)
def test_scenes_with_a_fault(by_hand, before, after, value):
    path = write_any(by_hand, BY_HAND.replace(before, after))
    refused(path, value, load_scene, (ValueError, OSError))
