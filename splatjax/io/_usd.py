"""Writing of scenes as USD, by usd-core."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from string import Template
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
    PointLight,
    RectangleLight,
    Scene,
    SphereLight,
    SpotLight,
)

from ._exchange import METERS, body_mesh, camera_pose, light_pose, strength
from ._files import StrPath, atomic_path, check_suffix
from ._lights import write_image
from ._materialx import openpbr_inputs

_SUFFIXES = (".usda", ".usdc", ".usd")
_FOCAL_LENGTH = 50.0  # focal length of the camera; the aperture follows from it
_FARTHEST = 1e3  # far clipping distance, m
_SCENE = Template("""#usda 1.0
(
    defaultPrim = "scene"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "scene"
{
    def Mesh "body" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        rel material:binding = </scene/material>
        uniform token subdivisionScheme = "none"
    }

    def Material "material"
    {
        token outputs:mtlx:surface.connect = <ND_open_pbr_surface_surfaceshader.outputs:out>
        token outputs:surface.connect = <UsdPreviewSurface.outputs:surface>

        def Shader "ND_open_pbr_surface_surfaceshader"
        {
            uniform token info:id = "ND_open_pbr_surface_surfaceshader"
            token outputs:out
            $openpbr
        }

        def Shader "UsdPreviewSurface"
        {
            uniform token info:id = "UsdPreviewSurface"
            token outputs:surface
            $preview
        }

        $albedo
    }

    def Camera "camera"
    {
        $camera
    }

    $lights
}
""")
# The vertex colors, for both surfaces.
_ALBEDO = """
        def Shader "ND_geompropvalue_color3"
        {
            uniform token info:id = "ND_geompropvalue_color3"
            string inputs:geomprop = "displayColor"
            color3f outputs:out
        }

        def Shader "UsdPrimvarReader_float3"
        {
            uniform token info:id = "UsdPrimvarReader_float3"
            string inputs:varname = "displayColor"
            float3 outputs:result
        }
"""
_LIGHT = Template("""
    def $kind "light_$number" (
        $schemas
    )
    {
        $attributes
    }
""")


def save_usd(
    path: StrPath, scene: Scene, camera: Camera, *, mesh: Mesh | None = None, g: float = 0.0
) -> None:
    r"""Write a scene as USD in meters: triangles, an OpenPBR material, camera and lights.

    If the splats have an albedo, it is stored as vertex colors and replaces the color of the
    subsurface. Renderers without OpenPBR show an opaque surface. The image of an `EnvironmentLight`
    is written beside the file, as EXR.

    **Arguments:**

    - `mesh`: closed triangles that bound the body, mm; `None` draws a hexagon for each splat.
    - `g`: mean cosine of the material's phase function (`load_mean_cosine`).

    A warning names lights that USD cannot store.

    **Raises:** `ValueError` for a suffix other than .usda, .usdc or .usd, without usd-core, and for
    a material of neither one nor three channels; `OSError` if the file cannot be written.
    """
    path = Path(path)
    check_suffix(path, *_SUFFIXES)
    check_installed(f"{path}: USD", "pxr", "usd-core")
    from pxr import Usd

    body = body_mesh(scene.splats, mesh)
    has_albedo = body.colors is not None
    openpbr, preview = _surfaces(openpbr_inputs(path, scene.material, 1 / METERS, g), has_albedo)
    text = _SCENE.substitute(
        openpbr=openpbr,
        preview=preview,
        albedo=_ALBEDO if has_albedo else "",
        camera=_camera(camera),
        lights="".join(_light(path, *numbered) for numbered in enumerate(scene.lights, 1)),
    )
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(text)
    _set_triangles(stage.GetPrimAtPath("/scene/body"), body)
    with atomic_path(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))


def _lines(attributes: Mapping[str, Any]) -> str:
    return "\n".join(f"{name} = {value}" for name, value in attributes.items())


def _placed(pose: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    matrix = tuple(map(tuple, pose.T.tolist()))
    return {
        "matrix4d xformOp:transform": matrix,
        "uniform token[] xformOpOrder": '["xformOp:transform"]',
    }


def _set_triangles(prim: Any, body: Mesh) -> None:
    from pxr import UsdGeom

    vertices, faces = np.asarray(body.vertices, np.float32), np.asarray(body.faces, np.int32)
    arrays = {
        "points": vertices,
        "normals": np.asarray(body.normals, np.float32),
        "extent": np.stack([vertices.min(axis=0), vertices.max(axis=0)]),
        "faceVertexCounts": np.full(len(faces), 3, np.int32),
        "faceVertexIndices": faces.ravel(),
    }
    for name, values in arrays.items():
        prim.GetAttribute(name).Set(values)
    if body.colors is not None:
        color = UsdGeom.Mesh(prim).CreateDisplayColorPrimvar("vertex")
        color.Set(np.asarray(body.colors, np.float32))


def _surfaces(inputs: Mapping[str, list[float]], has_albedo: bool) -> tuple[str, str]:
    """Format the inputs of OpenPBR, and of an opaque surface for renderers without OpenPBR."""
    values = {name: v[0] if len(v) == 1 else tuple(v) for name, v in inputs.items()}
    mtlx: dict[str, Any] = {
        f"{'float' if isinstance(value, float) else 'color3f'} inputs:{name}": value
        for name, value in values.items()
    }
    plain: dict[str, Any] = {
        "color3f inputs:diffuseColor": values["subsurface_color"],
        "float inputs:roughness": values["specular_roughness"],
        "float inputs:ior": values["specular_ior"],
    }
    if has_albedo:
        mtlx["color3f inputs:subsurface_color.connect"] = "<../ND_geompropvalue_color3.outputs:out>"
        plain["color3f inputs:diffuseColor.connect"] = "<../UsdPrimvarReader_float3.outputs:result>"
    return _lines(mtlx), _lines(plain)


def _camera(camera: Camera) -> str:
    size = np.asarray([camera.width, camera.height])
    point = np.asarray(camera.principal_pixel, float) / size
    aperture = _FOCAL_LENGTH / float(camera.focal_length) * size / camera.height
    offset = aperture * (0.5 - point) * [1, -1]
    (width, height), (right, up) = aperture.tolist(), offset.tolist()
    return _lines(
        {
            "float focalLength": _FOCAL_LENGTH,
            "float horizontalAperture": width,
            "float verticalAperture": height,
            "float horizontalApertureOffset": right,
            "float verticalApertureOffset": up,
            "float2 clippingRange": (METERS * float(camera.near), _FARTHEST),
            **_placed(camera_pose(camera)),
        }
    )


def _light(path: Path, number: int, light: AbstractLight) -> str:
    greatest, color = strength(light)
    kind, schemas, cone = type(light).__name__, "", dict[str, Any]()
    match light:
        case DirectionalLight():
            kind, entries = "DistantLight", {"float inputs:angle": 0, "bool inputs:normalize": 1}
        case PointLight() | SpotLight():  # a sphere of 1 mm whose radiance gives the intensity
            kind, entries = "SphereLight", {"float inputs:radius": METERS}
            greatest /= np.pi
        case SphereLight() | DiskLight():
            entries = {"float inputs:radius": METERS * float(light.radius)}
        case RectangleLight():
            edges = METERS * np.linalg.norm(np.asarray(light.edges, float), axis=1)
            height, width = edges.tolist()
            kind = "RectLight"
            entries = {"float inputs:width": width, "float inputs:height": height}
        case EnvironmentLight():
            image = path.with_name(f"{path.stem}_{number}.exr")
            write_image(image, light.image)
            kind, entries = "DomeLight", {"asset inputs:texture:file": f"@@@{image.name}@@@"}
            entries["token inputs:texture:format"] = '"latlong"'
        case _:
            warnings.warn(
                f"{path}: USD cannot store a {kind}, so the file lacks it; give another light",
                stacklevel=4,
            )
            return ""
    if isinstance(light, SpotLight):
        inner, outer = float(light.inner_angle), float(light.outer_angle)
        schemas = 'prepend apiSchemas = ["ShapingAPI"]'
        cone["float inputs:shaping:cone:angle"] = outer
        cone["float inputs:shaping:cone:softness"] = 1 - inner / outer
    attributes = {
        **entries,
        **cone,
        "float inputs:intensity": greatest,
        "color3f inputs:color": tuple(color),
        **_placed(light_pose(light)),
    }
    return _LIGHT.substitute(
        kind=kind, number=number, schemas=schemas, attributes=_lines(attributes)
    )
