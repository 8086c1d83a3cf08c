"""Scenes as glTF and USD, as pygltflib and OpenUSD read them."""

import warnings
from dataclasses import replace
from functools import partial
from importlib import util

import jax.numpy as jnp
import numpy as np
import OpenImageIO as oiio
import pygltflib
import pytest
from bodies import assert_close, assert_refused
from pxr import Gf, Usd, UsdGeom, UsdShade

import splatjax as sj
from splatjax.geometry import Mesh
from splatjax.io import load_camera, load_lights, save_gltf, save_usd
from splatjax.scattering import Medium
from splatjax.scene import DiskLight, RectangleLight, SphereLight, SpotLight

CAMERA = sj.Camera.look_at([50, 10, 90], [1, 2, 3], fov=30, width=200, height=160)
MEDIUM = Medium([0.3, 0.01, 1e-4], [0.5, 1.0, 2.0], 1.4)
GAUSSIANS = sj.SumOfGaussians([1.0, 4.0], [[0.2, 0.3, 0.4], [0.3, 0.3, 0.3]])
PUNCTUAL = (
    sj.DirectionalLight([1, -2, 3], [3, 2, 1]),
    sj.PointLight([50, 60, 70], [1e4, 2e4, 3e4]),
    SpotLight([50, 60, 70], [0, 0, -1], [1e4, 2e4, 3e4], 10, 25),
)
TRIANGLES = Mesh(
    np.asarray([[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]], float),
    np.asarray([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.full((4, 3), 3**-0.5),
)


def a_scene(*lights, medium: Medium | None = MEDIUM, has_albedo: bool = False) -> sj.Scene:
    """Splats at the corners of `TRIANGLES`, of a different albedo each."""
    albedo = np.arange(12).reshape(4, 3) / 15 if has_albedo else None
    splats = sj.Splats(TRIANGLES.vertices, TRIANGLES.normals, 1.0, 3.0, albedo)
    return sj.Scene(splats, lights, sj.Material(GAUSSIANS, 1.4, 0.5, 0.25, medium=medium))


def usd(path, *scene, **options) -> Usd.Stage:
    save_usd(path, *scene, **options)
    return Usd.Stage.Open(str(path))


def values(stage: Usd.Stage, name: str) -> dict[str, np.ndarray | str]:
    """Return the inputs of a shader or light by name."""
    attributes = stage.GetPrimAtPath(name).GetAttributes()
    inputs = {a.GetName().removeprefix("inputs:"): a.Get() for a in attributes}
    return {k: v if isinstance(v, str) else np.asarray(v) for k, v in inputs.items() if v}


def pose(stage: Usd.Stage, name: str) -> np.ndarray:
    """Return the matrix to the world, for rows."""
    prim = UsdGeom.Xformable(stage.GetPrimAtPath(name))
    return np.asarray(prim.ComputeLocalToWorldTransform(Usd.TimeCode.Default()))


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_openusd_projects_points_to_the_same_pixels(tmp_path, float64, suffix):
    camera = replace(CAMERA, principal_point=[0.4, 0.7])
    stage = usd(tmp_path / f"it.{suffix}", a_scene(), camera)
    frustum = UsdGeom.Camera.Get(stage, "/scene/camera").GetCamera(Usd.TimeCode.Default()).frustum
    to_picture = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    points = np.asarray([[0, 0, 0], [7, 5, -3], [-9, 4, 8.0]])
    found = [to_picture.Transform(Gf.Vec3d(*point)) for point in (points / 1000).tolist()]
    pixels = (np.asarray(found)[:, :2] * [1, -1] + 1) / 2 * [200, 160]
    x, y, z = (np.asarray(camera.rotation) @ (points - np.asarray(camera.position)).T).tolist()
    focal = float(camera.focal_length) * 160 / np.asarray(z)
    truth = np.stack([x, y], axis=1) * focal[:, None] + np.asarray(camera.principal_pixel)
    np.testing.assert_allclose(pixels, truth, atol=1e-4)


def test_gltf_has_the_camera_and_the_lights(tmp_path, float64):
    """As the importers read them, which are compared with files of other programs."""
    save_gltf(path := tmp_path / "it.glb", a_scene(*PUNCTUAL), CAMERA, lux=0.1)
    camera = load_camera(path, "camera", mm_per_unit=1000.0)
    expected = CAMERA.position, CAMERA.rotation
    assert_close((camera.position, camera.rotation), expected, atol=1e-9)
    np.testing.assert_allclose(camera.focal_length, CAMERA.focal_length, rtol=1e-9)
    found = load_lights(path, mm_per_unit=1000.0, lux=0.1)
    for light, truth in zip(found, PUNCTUAL, strict=True):
        assert type(light) is type(truth)
        points = jnp.asarray([[0, 0, 0], [52, 50, 9.0]])
        assert_close(light.incidence(points), truth.incidence(points), rtol=1e-6, atol=1e-9)


def test_the_coefficients_return_from_gltf(tmp_path, float64):
    """By the formulas of the extensions for volumes, in meters."""
    save_gltf(tmp_path / "it.glb", a_scene(), CAMERA)
    file = pygltflib.GLTF2().load(str(tmp_path / "it.glb"))
    (material,) = file.materials
    found = {key.removeprefix("KHR_materials_"): of for key, of in material.extensions.items()}
    assert {*material.extensions} == {*file.extensionsUsed}
    extinction = -np.log(found["volume"]["attenuationColor"])
    extinction /= 1000 * found["volume"]["attenuationDistance"]
    c = np.asarray(found["volume_scatter"]["multiscatterColor"])
    root = np.sqrt(9.59217 + 41.6808 * c + 17.7126 * c * c)
    albedo = 1 - (4.09712 + 4.20863 * c - root) ** 2
    np.testing.assert_allclose(extinction, MEDIUM.sigma_t_prime, rtol=1e-6)
    np.testing.assert_allclose(1 - albedo, MEDIUM.sigma_a / MEDIUM.sigma_t_prime, rtol=1e-3)
    assert found["ior"] == {"ior": 1.4}
    assert found["specular"] == {"specularFactor": 0.5}
    assert material.pbrMetallicRoughness.roughnessFactor == pytest.approx(0.5)


@pytest.mark.parametrize(("medium", "g"), [(MEDIUM, 0.8), (None, 0.0)])
def test_usd_has_the_surface_of_materialx(tmp_path, float64, medium, g):
    """In meters, and with the color of the splats where they have one."""
    scene = a_scene(medium=medium)
    stage = usd(tmp_path / "it.usda", scene, CAMERA, g=g)
    found = values(stage, "/scene/material/ND_open_pbr_surface_surfaceshader")
    path = 1000 * found["subsurface_radius"] * found["subsurface_radius_scale"]
    color = sj.exports.openpbr_subsurface(scene.material, g)["subsurface_color"]
    expected = sj.exports.mean_free_path(scene.material, g), color, 1.4
    assert_close((path, found["subsurface_color"], found["specular_ior"]), expected, rtol=1e-6)
    assert found.get("subsurface_scatter_anisotropy", 0.0) == pytest.approx(g)
    stage = usd(tmp_path / "of_splats.usda", a_scene(has_albedo=True), CAMERA)
    body = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/scene/body"))
    material, _ = body.ComputeBoundMaterial()
    for context, color in (("mtlx", "subsurface_color"), ("", "diffuseColor")):
        shader, *_ = material.ComputeSurfaceSource(context)
        source, name, _ = shader.GetInput(color).GetConnectedSource()
        assert "displayColor" in values(stage, str(source.GetPath())).values()
        assert source.GetOutput(name)


def test_lights_of_usd_shine_alike(tmp_path, float64):
    """Place, direction, extent and radiance, by the definitions of UsdLux."""
    image = np.random.default_rng(0).uniform(size=(4, 8, 3))
    areas = (
        RectangleLight([90, 0, 0], [1, 2, 4], [[0, 9, 0], [0, 0, 5]]),
        DiskLight([90, 0, 0], [1, 2, 4], [-1, 1, 0], 5.0),
        SphereLight([90, 0, 0], [1, 2, 4], 5.0),
        sj.EnvironmentLight(image, 30, [1, 2, 4], up=[0, 0, 1]),
    )
    stage = usd(tmp_path / "it.usda", a_scene(*PUNCTUAL, *areas), CAMERA)
    names = [f"/scene/light_{number}" for number in range(1, 8)]
    lights, poses = ([read(stage, name) for name in names] for read in (values, pose))
    for light, of, place in zip((*PUNCTUAL, *areas), lights, poses, strict=True):
        scale = np.pi * (1000 * of["radius"]) ** 2 if isinstance(light, sj.PointLight) else 1.0
        scale = scale if not isinstance(light, SpotLight) else np.pi
        strength = scale * of["intensity"] * of["color"]
        np.testing.assert_allclose(strength, getattr(light, light.strength_field), rtol=1e-6)
        center = getattr(light, "position", getattr(light, "center", np.zeros(3)))
        np.testing.assert_allclose(1000 * place[3, :3], center, atol=1e-9)
        if hasattr(light, "direction"):
            direction = np.asarray(light.direction) / np.linalg.norm(light.direction)
            np.testing.assert_allclose(-place[2, :3], direction, atol=1e-12)
    rectangle = poses[3][:3, :3] * np.asarray([lights[3]["width"], lights[3]["height"], 1])[:, None]
    edges = np.asarray(areas[0].edges)
    np.testing.assert_allclose(np.abs(1000 * rectangle[[1, 0]]), np.abs(edges), atol=1e-5)
    np.testing.assert_allclose(-rectangle[2], np.cross(*edges) / 45, atol=1e-12)
    spot = lights[2]["shaping:cone:angle"] * (
        1 - np.asarray([1, 0]) * lights[2]["shaping:cone:softness"]
    )
    np.testing.assert_allclose(spot, [10, 25], rtol=1e-6)
    np.testing.assert_allclose(poses[6][:3, :3].T, areas[3].to_world(), atol=1e-12)
    pixels = oiio.ImageBuf(str(tmp_path / "it_7.exr")).get_pixels(oiio.FLOAT)
    np.testing.assert_allclose(pixels, image, rtol=1e-6)


def test_the_body_is_the_mesh_or_a_hexagon_for_each_splat(tmp_path):
    scene = a_scene(has_albedo=True)
    stage = usd(tmp_path / "it.usda", scene, CAMERA, mesh=TRIANGLES)
    body = UsdGeom.Mesh.Get(stage, "/scene/body")
    np.testing.assert_allclose(1000 * np.asarray(body.GetPointsAttr().Get()), TRIANGLES.vertices)
    np.testing.assert_array_equal(body.GetFaceVertexIndicesAttr().Get(), TRIANGLES.faces.ravel())
    np.testing.assert_allclose(body.GetDisplayColorAttr().Get(), scene.splats.albedo, rtol=1e-6)
    stage = usd(tmp_path / "of_splats.usda", scene, CAMERA)
    body = UsdGeom.Mesh.Get(stage, "/scene/body")
    assert UsdGeom.Mesh.ValidateTopology(
        body.GetFaceVertexIndicesAttr().Get(), body.GetFaceVertexCountsAttr().Get(), 24
    )
    corners = 1000 * np.asarray(body.GetPointsAttr().Get()).reshape(4, 6, 3)
    offsets = corners - TRIANGLES.vertices[:, None]
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(offsets @ TRIANGLES.normals[0], 0.0, atol=1e-5)
    faces = corners.reshape(-1, 3)[np.reshape(body.GetFaceVertexIndicesAttr().Get(), (-1, 3))]
    sides = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    assert np.all(sides @ TRIANGLES.normals[0] > 0)


def test_what_cannot_be_written_is_named(tmp_path, monkeypatch):
    glb, usda = tmp_path / "it.glb", tmp_path / "it.usda"
    beam = sj.GaussianBeam([0, 0, 9], [0, 0, -1], 5.0, 4.0)
    two = sj.SumOfGaussians([1.0], [[0.5] * 2])
    others = beam, SphereLight([9, 9, 9], 1.0, 2.0), replace(PUNCTUAL[2], outer_angle=120)
    with pytest.warns(UserWarning, match=r"it\.glb: .*4 \(Gauss.* 5 \(Sphere.* 6 \(Spot.*USD"):
        save_gltf(glb, a_scene(*PUNCTUAL, *others), CAMERA)
    assert len(load_lights(glb, mm_per_unit=1.0)) == 3
    with pytest.warns(UserWarning, match=r"it\.glb: .*principal"):
        save_gltf(glb, a_scene(), replace(CAMERA, principal_point=[0.4, 0.7]))
    with pytest.warns(UserWarning, match=r"it\.usda: .*GaussianBeam"):
        save_usd(usda, a_scene(beam), CAMERA)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    scene = replace(a_scene(), material=sj.Material(two))
    with warnings.catch_warnings(action="error"):
        for save, path, given in (
            (save_gltf, glb, scene),
            (save_usd, usda, scene),
            (save_gltf, tmp_path / "it.gltf", a_scene()),
            (save_usd, tmp_path / "it.usdz", a_scene()),
        ):
            assert_refused(partial(save, path, given, CAMERA), path.name)
        for lux in (0.0, -1.0, np.nan):
            assert_refused(partial(save_gltf, glb, a_scene(), CAMERA, lux=lux), "lux must be")
            assert_refused(partial(load_lights, glb, mm_per_unit=1.0, lux=lux), "lux must be")
        monkeypatch.setattr(util, "find_spec", lambda name: None)
        assert_refused(partial(save_usd, usda, a_scene(), CAMERA), r"it\.usda: .*usd-core")
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
