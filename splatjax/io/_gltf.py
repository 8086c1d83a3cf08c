"""Writing of scenes as binary glTF, by trimesh."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from splatjax._records import check_values
from splatjax.exports import gltf_volume, plain_numbers
from splatjax.geometry import Mesh
from splatjax.scene import (
    AbstractLight,
    Camera,
    DirectionalLight,
    Material,
    PointLight,
    Scene,
    SpotLight,
)

from ._exchange import METERS, body_mesh, camera_pose, light_pose, strength
from ._files import StrPath, atomic_path, check_suffix
from ._materialx import check_colors

_LIGHTS = "KHR_lights_punctual"
_KINDS: dict[type[AbstractLight], str] = {
    DirectionalLight: "directional",
    PointLight: "point",
    SpotLight: "spot",
}


def save_gltf(
    path: StrPath, scene: Scene, camera: Camera, *, mesh: Mesh | None = None, lux: float = 1.0
) -> None:
    r"""Write a scene as a binary glTF file: triangles, material, camera, and punctual lights.

    The material uses the extensions for volume, volume scattering (a draft), diffuse transmission,
    index of refraction and specular strength. The albedo of the splats is stored as vertex colors,
    which viewers without these extensions show.

    **Arguments:**

    - `mesh`: closed triangles that bound the body, mm, which volumes require; `None` draws a
      hexagon for each splat.
    - `lux`: irradiance of 1 lux in the unit of the lights, as for `load_lights`.

    A warning reports contents that glTF cannot store: lights of other kinds, spot lights wider than
    a half-space, and a principal point away from the middle of the picture.

    **Raises:** `ValueError` for a suffix other than .glb, for a `lux` that is not positive, and for
    a material of neither one nor three channels; `OSError` if the file cannot be written.
    """
    import trimesh  # takes a second
    from trimesh.exchange.gltf import export_glb

    check_suffix(path, ".glb")
    check_values("lux", lux, "positive", lambda x: x > 0)
    body = body_mesh(scene.splats, mesh)
    colors = None if body.colors is None else np.round(255 * body.colors).astype(np.uint8)
    shown = trimesh.Trimesh(
        body.vertices,
        body.faces,
        vertex_normals=body.normals,
        vertex_colors=colors,
        process=False,
    )
    thickness = float(np.min(np.ptp(shown.vertices, axis=0)))
    material = _material(path, scene.material, colors is not None, thickness)
    if camera.principal_point is not None:
        warnings.warn(
            f"{path}: glTF has no principal point, and its camera looks at the middle of the "
            "picture; write USD, or leave out principal_point",
            stacklevel=2,
        )
    named = [light for light in scene.lights if _is_punctual(light)]
    if len(named) < len(scene.lights):
        lost = ", ".join(
            f"light {number} ({type(light).__name__})"
            for number, light in enumerate(scene.lights, 1)
            if not _is_punctual(light)
        )
        warnings.warn(
            f"{path}: glTF cannot store {lost}, so the file lacks them; write USD, or give "
            "directional and point lights, and spot lights with angles up to 90 degrees",
            stacklevel=2,
        )

    def complete(tree: dict[str, Any]) -> None:
        for primitive in tree["meshes"][0]["primitives"]:
            primitive["material"] = 0
        aspect = camera.width / camera.height
        yfov = 2 * np.arctan(0.5 / float(camera.focal_length))
        lens = {"yfov": float(yfov), "aspectRatio": aspect, "znear": METERS * float(camera.near)}
        pose = _matrix(camera_pose(camera))
        nodes: list[dict[str, Any]] = [{"name": "camera", "camera": 0, "matrix": pose}]
        nodes += [
            {
                "name": f"light {number + 1}",
                "matrix": _matrix(light_pose(light)),
                "extensions": {_LIGHTS: {"light": number}},
            }
            for number, light in enumerate(named)
        ]
        first = len(tree["nodes"])
        tree["nodes"] += nodes
        tree["scenes"][0]["nodes"] += range(first, first + len(nodes))
        tree["cameras"] = [{"type": "perspective", "perspective": lens}]
        tree["materials"] = [material]
        tree["extensionsUsed"] = [*material["extensions"]]
        if named:  # glTF forbids an empty list of lights
            tree["extensionsUsed"].append(_LIGHTS)
            tree["extensions"] = {_LIGHTS: {"lights": [_light(light, lux) for light in named]}}

    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(
            export_glb(trimesh.Scene(shown), include_normals=True, tree_postprocessor=complete)
        )


def _material(path: StrPath, material: Material, has_albedo: bool, thickness: float) -> Any:
    check_colors(path, material)
    distance, attenuation, scattered = map(np.asarray, gltf_volume(material))
    total = np.asarray(material.total_reflectance())
    color = np.ones(3) if has_albedo else np.broadcast_to(total, 3)
    extensions = {
        "ior": {"ior": material.eta},
        "specular": {"specularFactor": material.specular},
        "diffuse_transmission": {"diffuseTransmissionFactor": np.float64(1)},
        "volume": {
            "thicknessFactor": np.float64(thickness),
            "attenuationDistance": np.float64(METERS * distance),
            "attenuationColor": np.broadcast_to(attenuation, 3),
        },
        "volume_scatter": {
            "multiscatterColor": np.broadcast_to(scattered, 3),
            "scatterAnisotropy": np.float64(0),
        },
    }
    return {
        "name": "material",
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*plain_numbers(color), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": float(material.roughness) ** 0.5,
        },
        "extensions": {
            f"KHR_materials_{name}": {key: plain_numbers(value) for key, value in entries.items()}
            for name, entries in extensions.items()
        },
    }


def _is_punctual(light: AbstractLight) -> bool:
    return type(light) in _KINDS and float(getattr(light, "outer_angle", 0)) <= 90


def _light(light: AbstractLight, lux: float) -> dict[str, Any]:
    greatest, color = strength(light)
    is_distant = isinstance(light, DirectionalLight)
    entry = {
        "type": _KINDS[type(light)],
        "color": color,
        "intensity": greatest / lux * (1.0 if is_distant else METERS**2),
    }
    if isinstance(light, SpotLight):
        angles = np.radians([light.inner_angle, light.outer_angle]).tolist()
        entry["spot"] = dict(zip(("innerConeAngle", "outerConeAngle"), angles, strict=True))
    return entry


def _matrix(pose: np.ndarray) -> list[float]:
    return pose.T.ravel().tolist()  # in column-major order
