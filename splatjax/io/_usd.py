"""Scenes as USD, by usd-core."""

import importlib.util
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatjax.geometry import Mesh
from splatjax.scene import (
    AbstractLight,
    Camera,
    DirectionalLight,
    DiskLight,
    EnvironmentLight,
    Material,
    PointLight,
    RectangleLight,
    Scene,
    SphereLight,
    SpotLight,
)

from ._exchange import METERS, body_mesh, camera_pose, light_pose, strength
from ._files import StrPath, atomic_path, naming
from ._lights import write_image
from ._materialx import openpbr_inputs

_SUFFIXES = (".usda", ".usdc", ".usd")
_FOCAL_LENGTH = 50.0  # of a camera whose aperture follows
_FARTHEST = 1e3  # m, that a camera sees


def save_usd(path: StrPath, scene: Scene, camera: Camera, *, mesh: Mesh | None = None) -> None:
    r"""Write a scene as USD: triangles, an OpenPBR material, camera and lights, in meters.

    The color of the subsurface is the albedo of the splats, as the color of the vertices, if there
    is one; else that of the material. Renderers without OpenPBR show an opaque surface. The image
    of an `EnvironmentLight` is written beside, as EXR.

    **Arguments:**

    - `mesh`: closed triangles that bound the body, mm; `None` draws a hexagon for each splat.

    A warning names lights that USD does not have.

    **Raises:** `ValueError` for another suffix than .usda, .usdc or .usd, without usd-core, or for
    a material of neither one nor three channels; `OSError` if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{path}: the name of this file must end in {' or '.join(_SUFFIXES)}")
    if importlib.util.find_spec("pxr") is None:
        raise ValueError(f"{path}: USD needs usd-core; install it: pip install usd-core")
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
    body = body_mesh(scene.splats, mesh)
    with naming(path):
        material = _material(stage, scene.material, body.colors is not None)
    UsdShade.MaterialBindingAPI.Apply(_body(stage, body)).Bind(material)
    _camera(stage, camera)
    for number, light in enumerate(scene.lights, 1):
        _light(stage, light, number, path)
    with atomic_path(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))


def _body(stage: Any, body: Mesh) -> Any:
    from pxr import UsdGeom, Vt

    def rows(values: np.ndarray | list[np.ndarray]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.asarray(values, np.float32))

    shape = UsdGeom.Mesh.Define(stage, "/scene/body")
    shape.CreatePointsAttr(rows(body.vertices))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(body.faces), 3, np.int32)))
    faces = np.asarray(body.faces, np.int32).ravel()
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces))
    shape.CreateExtentAttr(rows([body.vertices.min(axis=0), body.vertices.max(axis=0)]))
    shape.CreateSubdivisionSchemeAttr("none")
    shape.CreateNormalsAttr(rows(body.normals))
    shape.SetNormalsInterpolation("vertex")
    if body.colors is not None:
        shape.CreateDisplayColorPrimvar("vertex").Set(rows(body.colors))
    return shape.GetPrim()


def _material(stage: Any, material: Material, has_albedo: bool) -> Any:
    """Define the material as OpenPBR, and as an opaque surface for renderers that lack it."""
    from pxr import UsdShade

    shown = UsdShade.Material.Define(stage, "/scene/material")
    inputs = openpbr_inputs(material, 1 / METERS)
    plain = {
        "diffuseColor": inputs["subsurface_color"],
        "roughness": inputs["specular_roughness"],
        "ior": inputs["specular_ior"],
    }
    surface = _shader(stage, "ND_open_pbr_surface_surfaceshader", inputs)
    preview = _shader(stage, "UsdPreviewSurface", plain)
    shown.CreateSurfaceOutput("mtlx").ConnectToSource(_output(surface, "out", "Token"))
    shown.CreateSurfaceOutput().ConnectToSource(_output(preview, "surface", "Token"))
    if has_albedo:
        albedo = _shader(stage, "ND_geompropvalue_color3", {"geomprop": "displayColor"})
        color = surface.GetInput("subsurface_color")
        color.ConnectToSource(_output(albedo, "out", "Color3f"))
        albedo = _shader(stage, "UsdPrimvarReader_float3", {"varname": "displayColor"})
        color = preview.GetInput("diffuseColor")
        color.ConnectToSource(_output(albedo, "result", "Float3"))
    return shown


def _shader(stage: Any, kind: str, inputs: Mapping[str, str | list[float]]) -> Any:
    from pxr import Sdf, UsdShade

    shader = UsdShade.Shader.Define(stage, f"/scene/material/{kind}")
    shader.CreateIdAttr(kind)
    for name, value in inputs.items():
        if isinstance(value, str):
            shader.CreateInput(name, Sdf.ValueTypeNames.String).Set(value)
        elif len(value) == 1:
            shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value[0])
        else:
            shader.CreateInput(name, Sdf.ValueTypeNames.Color3f).Set(tuple(value))
    return shader


def _output(shader: Any, name: str, kind: str) -> Any:
    from pxr import Sdf

    return shader.CreateOutput(name, getattr(Sdf.ValueTypeNames, kind))


def _camera(stage: Any, camera: Camera) -> None:
    from pxr import UsdGeom

    lens = UsdGeom.Camera.Define(stage, "/scene/camera")
    size = (
        _FOCAL_LENGTH / float(camera.focal_length) * np.asarray([camera.width / camera.height, 1.0])
    )
    point = np.asarray(camera.principal_pixel, float) / [camera.width, camera.height]
    offset = size * (0.5 - point) * [1, -1]
    lens.CreateFocalLengthAttr(_FOCAL_LENGTH)
    lens.CreateHorizontalApertureAttr(float(size[0]))
    lens.CreateVerticalApertureAttr(float(size[1]))
    lens.CreateHorizontalApertureOffsetAttr(float(offset[0]))
    lens.CreateVerticalApertureOffsetAttr(float(offset[1]))
    lens.CreateClippingRangeAttr((METERS * float(camera.near), _FARTHEST))
    _place(lens, camera_pose(camera))


def _light(stage: Any, light: AbstractLight, number: int, path: Path) -> None:
    from pxr import UsdGeom, UsdLux

    greatest, color = strength(light)
    match light:
        case DirectionalLight():
            kind, inputs = "DistantLight", {"angle": 0.0, "normalize": True}
        case PointLight() | SpotLight():  # a sphere of 1 mm whose radiance gives the intensity
            kind, inputs = "SphereLight", {"radius": METERS}
            greatest /= np.pi
        case SphereLight():
            kind, inputs = "SphereLight", {"radius": METERS * float(light.radius)}
        case DiskLight():
            kind, inputs = "DiskLight", {"radius": METERS * float(light.radius)}
        case RectangleLight():
            edges = METERS * np.linalg.norm(np.asarray(light.edges, float), axis=1)
            height, width = edges.tolist()
            kind, inputs = "RectLight", {"width": width, "height": height}
        case EnvironmentLight():
            image = path.with_name(f"{path.stem}_{number}.exr")
            write_image(image, light.image)
            kind, inputs = "DomeLight", {"texture:file": image.name, "texture:format": "latlong"}
        case _:
            warnings.warn(
                f"{path}: USD has no {type(light).__name__}, and is written without it; give "
                "another light",
                stacklevel=3,
            )
            return
    prim = stage.DefinePrim(f"/scene/light_{number}", kind)
    shared: dict[str, Any] = {"intensity": greatest, "color": tuple(color)}
    if isinstance(light, SpotLight):
        inner, outer = float(light.inner_angle), float(light.outer_angle)
        UsdLux.ShapingAPI.Apply(prim)
        shared |= {"shaping:cone:angle": outer, "shaping:cone:softness": 1 - inner / outer}
    for name, value in (inputs | shared).items():
        prim.GetAttribute(f"inputs:{name}").Set(value)
    _place(UsdGeom.Xformable(prim), light_pose(light))


def _place(of: Any, pose: np.ndarray) -> None:
    from pxr import Gf

    of.AddTransformOp().Set(Gf.Matrix4d(pose.T))
