"""Scenes as TOML files, and as manifests of pictures."""

import tomllib
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
import trimesh
from test_refusals import refused, write_any
from writers import some_frame, some_splats

import splatjax as sj
from splatjax.io import load_cameras, load_scene, save_scene

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
        sj.EnvironmentLight(np.random.default_rng(0).uniform(size=(4, 8, 3)), 30, [1, 2, 3]),
    )
    lights = (*lights, replace(lights[-1], directions=sj.scene.even_directions(5)))
    scene = sj.Scene(some_splats(), lights, sj.load_material("marble"))
    camera = replace(CAMERA, principal_point=[0.4, 0.6], near=0.5)
    save_scene(tmp_path / "a.toml", scene, camera, SHAPE)
    assert eqx.tree_equal(load_scene(tmp_path / "a.toml"), (scene, camera, SHAPE), **CLOSE)
    manifest = {"scene": tomllib.loads((tmp_path / "a.toml").read_text())}
    sj.write_exr(tmp_path / "a.exr", some_frame(), manifest=manifest)
    assert eqx.tree_equal(load_scene(tmp_path / "a.exr"), (scene, camera, SHAPE), **CLOSE)
    for diffuser in (sj.diffusion.ExitanceDiffuser(), sj.diffusion.ClusterDiffuser()):
        save_scene(tmp_path / "b.toml", scene, camera, sj.RenderSettings(diffuser=diffuser), g=0.25)
        assert load_scene(tmp_path / "b.toml")[2].diffuser == diffuser
    material = sj.io.material_of_scene(sj.io.scene_table(tmp_path / "b.toml"))
    assert sj.io.load_mean_cosine(material) == 0.25
    with pytest.raises(ValueError, match=r"a\.toml: stores only bounces"):
        save_scene(
            tmp_path / "a.toml", scene, camera, replace(SHAPE, kernel=sj.diffusion.PlainMean())
        )
    harmonics = sj.scene.HarmonicLight(np.zeros((9, 3)))
    with pytest.raises(ValueError, match="cannot store a HarmonicLight"):
        save_scene(tmp_path / "a.toml", replace(scene, lights=(harmonics,)), camera)


@pytest.fixture
def by_hand(tmp_path):
    (tmp_path / "body").mkdir()
    (tmp_path / "cameras").symlink_to(Path(__file__).with_name("cameras"))
    trimesh.creation.box((1, 1, 9)).export(tmp_path / "body" / "box.stl")
    return write_any(tmp_path / "a.toml", BY_HAND)


def test_a_scene_by_hand_names_files_beside_it(by_hand):
    scene, camera, settings = load_scene(by_hand)
    assert scene.splats.count == 60
    assert np.ptp(np.asarray(scene.splats.centers), axis=0).argmax() == 1
    assert eqx.tree_equal(scene.material, sj.load_material("marble"))
    sky = sj.EnvironmentLight(sj.scene.overcast_sky(), 20, [1, 1, 1])
    assert eqx.tree_equal(scene.lights, (sky,))
    assert eqx.tree_equal(settings, sj.RenderSettings())
    expected = load_cameras(by_hand.with_name("cameras") / "colmap", mm_per_unit=2.0)["left 1.png"]
    assert eqx.tree_equal(camera, replace(expected, width=320, height=240), **CLOSE)


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
    path = write_any(by_hand, BY_HAND.split("[[lights]]")[0] + AIMED)
    scene, *others = load_scene(path)
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
    both = AIMED.replace("radius", "direction = [0, 0, 1]\nradius")
    path = write_any(by_hand, BY_HAND.split("[[lights]]")[0] + both)
    refused(path, "unknown entry 'direction'", load_scene, ValueError)


@pytest.mark.parametrize(
    ("before", "after", "value"),
    [
        ('"marble"', '"marbel"', "'marble'"),
        ('"marble"', "5", "[material] must be a table"),
        ("mesh", "meshes", "[splats] has an unknown entry 'meshes'"),
        ('"body/box.stl"', "5", "[splats] mesh must be a name in quotes; it is 5"),
        ("box.stl", "none.stl", "none.stl"),
        ("mm_per_unit = 10", "", "[splats] mm_per_unit"),
        ("count = 60", "count = 60\nscale = true", "[splats] scale"),
        ('"left 1.png"', '"7"', "has no camera '7'; give one of its 3 names"),
        ('file = "cameras/colmap"\nname', "position = [0, 0, 9]\nname", "[camera] rotation"),
        ('"overcast"', '"fog.exr"', "fog.exr"),
        ("[[lights]]", "[settings]\nbounces = -1\n[[lights]]", "[settings]"),
        ("[[lights]]", '[settings]\ndiffusion = "dipole"\n[[lights]]', "diffusion must be"),
        ("[[lights]]", "[lights]", "lights must be one table or more"),
    ],
)
def test_scenes_with_a_fault(by_hand, before, after, value):
    path = write_any(by_hand, BY_HAND.replace(before, after))
    refused(path, value, load_scene, (ValueError, OSError))
