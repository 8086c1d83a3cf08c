"""Scenes as USD, by usd-core."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatjax._records import check_installed
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
_FOCAL_LENGTH = 50.0  # focal length of the camera; the aperture follows from it
_FARTHEST = 1e3  # far clipping distance, m


def save_usd(path: StrPath, scene: Scene, camera: Camera, *, mesh: Mesh | None = None) -> None:
    r"""Write a scene as USD: triangles, an OpenPBR material, camera and lights, in meters.

    The color of the subsurface is the albedo of the splats, stored as vertex colors, if there is
    one; else it is the color of the material. Renderers without OpenPBR show an opaque surface. The
    image of an `EnvironmentLight` is written beside the file, as EXR.

    **Arguments:**

    - `mesh`: closed triangles that bound the body, mm; `None` draws a hexagon for each splat.

    A warning names lights that USD cannot store.

    **Raises:** `ValueError` for another suffix than .usda, .usdc or .usd, without usd-core, or for
    a material of neither one nor three channels; `OSError` if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{path}: the name of this file must end in {' or '.join(_SUFFIXES)}")
    check_installed(f"{path}: USD", "pxr", "usd-core")
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


def _define(
    stage: Any,
    name: str,
    kind: str,
    attributes: Mapping[str, Any],
    pose: Float[np.ndarray, "4 4"] | None = None,
) -> Any:
    from pxr import Gf, UsdGeom

    prim = stage.DefinePrim(f"/scene/{name}", kind)
    for key, value in attributes.items():
        prim.GetAttribute(key).Set(value)
    if pose is not None:
        UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(pose.T))
    return prim


def _body(stage: Any, body: Mesh) -> Any:
    from pxr import UsdGeom, Vt

    points, normals, extent = (
        Vt.Vec3fArray.FromNumpy(np.asarray(rows, np.float32))
        for rows in (body.vertices, body.normals, [body.vertices.min(0), body.vertices.max(0)])
    )
    faces = np.asarray(body.faces, np.int32)
    attributes = {
        "points": points,
        "normals": normals,
        "extent": extent,
        "faceVertexCounts": Vt.IntArray(len(faces), 3),
        "faceVertexIndices": Vt.IntArray.FromNumpy(faces.ravel()),
        "subdivisionScheme": "none",
    }
    prim = _define(stage, "body", "Mesh", attributes)
    if body.colors is not None:
        colors = Vt.Vec3fArray.FromNumpy(np.asarray(body.colors, np.float32))
        UsdGeom.Mesh(prim).CreateDisplayColorPrimvar("vertex").Set(colors)
    return prim


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
    size = np.asarray([camera.width, camera.height])
    point = np.asarray(camera.principal_pixel, float) / size
    aperture = _FOCAL_LENGTH / float(camera.focal_length) * size / camera.height
    offset = aperture * (0.5 - point) * [1, -1]
    attributes = {
        "focalLength": _FOCAL_LENGTH,
        "horizontalAperture": aperture[0],
        "verticalAperture": aperture[1],
        "horizontalApertureOffset": offset[0],
        "verticalApertureOffset": offset[1],
        "clippingRange": (METERS * float(camera.near), _FARTHEST),
    }
    _define(stage, "camera", "Camera", attributes, camera_pose(camera))


def _light(stage: Any, light: AbstractLight, number: int, path: Path) -> None:
    from pxr import UsdLux

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
    inputs = {f"inputs:{name}": value for name, value in inputs.items()}
    inputs |= {"inputs:intensity": greatest, "inputs:color": tuple(color)}
    prim = _define(stage, f"light_{number}", kind, inputs, light_pose(light))
    if isinstance(light, SpotLight):
        inner, outer = float(light.inner_angle), float(light.outer_angle)
        cone = UsdLux.ShapingAPI.Apply(prim)
        cone.CreateShapingConeAngleAttr(outer)
        cone.CreateShapingConeSoftnessAttr(1 - inner / outer)
