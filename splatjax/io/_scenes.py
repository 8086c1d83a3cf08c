"""Scenes in TOML files, with splats or a mesh, material, lights, camera and settings; and scenes in
the manifests of pictures.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx

from splatjax.diffusion import ClusterDiffuser, ExitanceDiffuser, ShapeDiffuser
from splatjax.geometry import Mesh, bust, bust_mesh
from splatjax.render import RenderSettings
from splatjax.scene import Camera, EnvironmentLight, Material, Scene, Splats

from ._cameras import load_camera, resized
from ._files import StrPath, existing_file, expect, naming, plain_record, record_names
from ._images import MANIFEST, read_planes
from ._lights import LIGHT_ENTRIES, PLACE, light_of, look_at, plain_light, write_image
from ._materials import MATERIAL_TABLES, load_material, plain_material
from ._meshes import read_textured_mesh, sample_mesh
from ._ply import read_splats, write_splats
from ._tables import Table, read_toml, write_toml

DIFFUSERS = {
    "clusters": ClusterDiffuser(),
    "exitance": ExitanceDiffuser(),
    "shape": ShapeDiffuser(),
}
_TABLES = ("material", "splats", "camera", "lights", "settings")
_MAPS = ("albedo", "normal", "specular")
# Entries of [splats] for each kind of body, and of [camera] for each kind of camera.
_BODIES = {
    "bust": {"bust", "up", "scale", "albedo"},
    "mesh": {"mesh", "count", "mm_per_unit", "up", "scale", "v_up", *_MAPS},
    "file": {"file", "mm_per_unit", "up", "scale", "albedo"},
}
_CAMERAS = {
    "file": {"file", "name", "mm_per_unit", "up", "height"},
    "target": {*PLACE, "width", "height"},
    "rotation": {*record_names(Camera)},
}


def load_scene(path: StrPath) -> tuple[Scene, Camera, RenderSettings]:
    r"""Load a scene, its camera and the settings of `render`.

        material = "marble"          # a name, or a file beside this one; or the tables of a file
        [splats]
        file = "head.ply"            # or mesh = "head.glb", count and mm_per_unit; or bust = 200000
                                     # a mesh may have albedo = "color.jpg", normal, specular, v_up
        up = "y"                     # optional, as are scale = 1.0 and albedo = true
        [camera]
        position = [0, 0, 620]       # mm; target, up, near, and the vertical fov in degrees
        target = [0, -40, 0]
        fov = 25
        width = 512
        height = 512
        [[lights]]
        kind = "environment"         # directional, point, spot, beam, rectangle, disk or sphere
        image = "studio"             # overcast, sun, or a file; rotation, strength, up
        [settings]                   # optional
        bounces = 1
        diffusion = "clusters"       # exitance or shape

    `read_observations` lists the entries of the other lights. A camera may instead have `position`,
    `rotation`, `focal_length` and `principal_point`, or `file`, `name`, `mm_per_unit` and `up`
    (`load_cameras`); the position of a camera from a file is scaled with the splats. If the splats
    have an albedo, the weights of a material given by name or file are divided by their sums, as on
    the command line.

    **Arguments:** `path`: a TOML file, or a picture that the command line rendered.

    **Raises:** `ValueError` for invalid content, with the fault and the remedy; `FileNotFoundError`
    for a missing file.
    """
    file = scene_table(path)
    body = file.table_of_kind("splats", _BODIES)
    splats = _splats(body)
    source = material_of_scene(file)
    if isinstance(source, Table):
        material = load_material(source)
    else:
        material = file.make(load_material, source)
        material = material if splats.albedo is None else material.white()
    expect(
        material.wavelengths is None or splats.albedo is None,
        path,
        "has a material of wavelengths, and splats with albedo in red, green and blue; give "
        "`albedo = false` in [splats]",
    )
    lights = [
        light_of(light, material.channels, material.wavelengths is not None)
        for light in file.tables("lights", LIGHT_ENTRIES, least=0)
    ]
    table = file.table("settings", ("bounces", "diffusion"))
    settings = table.make(
        RenderSettings,
        diffuser=DIFFUSERS[table.one_of("diffusion", DIFFUSERS, "clusters")],
        bounces=table.whole("bounces", 0.0),
    )
    scene = file.make(Scene, splats, lights, material)
    camera = _camera(file.table_of_kind("camera", _CAMERAS), body.number("scale", 1.0))
    return scene, camera, settings


def scene_table(path: StrPath) -> Table:
    """Return the contents of a scene file, or of the manifest of a picture."""
    path = Path(path)
    if path.suffix.lower() == ".exr":
        scene = read_manifest(path).get("scene")
    else:
        scene = read_toml(path, "give the file of a scene, or a picture")
    expect(
        not isinstance(scene, dict) or scene.keys() & {*_TABLES},
        path,
        "has no [splats], [camera] or [[lights]]; give the file of a scene, whose `material` may "
        "be this one",
    )
    table = Table(path, "", scene, _TABLES)
    table.entries.setdefault("settings", {})
    return table


def read_manifest(path: StrPath) -> dict[str, Any]:
    r"""Read the manifest of a picture, in which the command line records settings and material.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read or has no manifest.
    """
    _, header, _ = read_planes(path)
    expect(
        isinstance(header.get(MANIFEST), str),
        path,
        "has no record of its settings; give a picture that `splatjax render` wrote",
    )
    with naming(path):
        return json.loads(header[MANIFEST])


def material_of_scene(file: Table) -> StrPath | Table:
    """Return the name, path or tables of the material in a scene file."""
    name = file.entries.get("material")
    if not isinstance(name, str):
        return file.table("material", MATERIAL_TABLES)
    return file.folder / name if Path(name).suffix else name


def mesh_of_scene(file: Table) -> Mesh | None:
    """Return the mesh (mm) from which the splats of a scene file are sampled, or `None`."""
    table = file.table_of_kind("splats", _BODIES)
    if "bust" in table.entries:
        mesh = bust_mesh()
    elif "mesh" in table.entries:
        path, unit = _body(table)
        mesh, _ = read_textured_mesh(path, **unit)
    else:
        return None
    return replace(mesh, vertices=table.number("scale", 1.0) * mesh.vertices)


def save_scene(
    path: StrPath,
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    *,
    g: float = 0.0,
) -> None:
    r"""Write a scene to a TOML file, its splats to a PLY file of the same name, and images of its
    environments to EXR files, for `load_scene`.

    Numbers are restored exactly, except that splats and environments are stored in single
    precision. `g` is the mean cosine of the material's phase function.

    **Raises:** `ValueError` for settings other than bounces and diffusion, and for lights that a
    file cannot store; `OSError` if a file cannot be written.
    """
    path, lights = Path(path), []
    plain = RenderSettings(bounces=settings.bounces, diffuser=settings.diffuser)
    expect(
        eqx.tree_equal(settings, plain) and settings.diffuser in DIFFUSERS.values(),
        path,
        "stores only bounces and a default ClusterDiffuser, ExitanceDiffuser or ShapeDiffuser; "
        f"keep other settings in the program: {settings}",
    )
    for number, light in enumerate(scene.lights, 1):
        image = path.with_name(f"{path.stem}_{number}.exr")
        lights.append(plain_light(light, image.name))
        if isinstance(light, EnvironmentLight):
            expect(
                light.image.shape[-1] in ((1, 3) if scene.material.wavelengths is None else (1,)),
                path,
                f"cannot store an environment of {light.image.shape[-1]} channels; give a gray "
                "image of one channel (or, without wavelengths, one of red, green and blue)",
            )
            write_image(image, light.image)
    write_splats(path.with_suffix(".ply"), scene.splats)
    splats = {"file": path.with_suffix(".ply").name}
    write_toml(path, plain_scene(splats, scene.material, camera, lights, settings, g))


def plain_scene(
    splats: Mapping[str, Any],
    material: Material,
    camera: Camera,
    lights: Sequence[Mapping[str, Any]],
    settings: RenderSettings,
    g: float = 0.0,
) -> dict[str, Any]:
    """Return the contents of a scene file with given [splats] and [[lights]]."""
    kinds = {type(diffuser): name for name, diffuser in DIFFUSERS.items()}
    diffusion = kinds.get(type(settings.diffuser), "clusters")
    return {
        "material": plain_material(material, g=g),
        "splats": dict(splats),
        "camera": plain_record(camera),
        "lights": list(lights),
        "settings": {"bounces": settings.bounces, "diffusion": diffusion},
    }


def _splats(table: Table) -> Splats:
    has_map = "mesh" in table.entries and isinstance(table.entries.get("albedo"), str)
    albedo = has_map or table.one_of("albedo", (True, False), True)
    if "bust" in table.entries:
        table.one_of("up", ("y",), "y")
        splats = bust(table.whole("bust"))
    else:
        count, (body, unit) = table.whole("count", 200_000.0), _body(table)
        is_mesh = "mesh" in table.entries
        splats = sample_mesh(body, count, **unit) if is_mesh else read_splats(body, **unit)
    scale = table.number("scale", 1.0)
    splats = splats if scale == 1 else table.make(splats.scaled, scale)
    return splats if albedo else splats.without_maps()


def _body(table: Table) -> tuple[Path, dict[str, Any]]:
    """Return the file of a body, its unit and upward axis, and the maps of a mesh."""
    is_mesh = "mesh" in table.entries
    unit = table.number("mm_per_unit", None if is_mesh else 1.0)
    path = table.make(existing_file, table.folder / table.text("mesh" if is_mesh else "file"))
    v_up = {"v_up": table.one_of("v_up", (True, False))} if "v_up" in table.entries else {}
    maps: dict[str, Any] = v_up | {
        name: table.folder / table.text(name)
        for name in _MAPS
        if not isinstance(table.entries.get(name, True), bool)
    }
    return path, {"mm_per_unit": unit, "up": table.entries.get("up", "y"), **maps}


def _camera(table: Table, scale: float) -> Camera:
    """Make a camera. That of a file is scaled with the body."""
    entries, height = table.entries, table.whole("height", 512.0)
    if "file" in entries:
        file, name = table.folder / table.text("file"), str(entries.get("name", "0"))
        unit = {"mm_per_unit": table.number("mm_per_unit"), "up": entries.get("up", "y")}
        camera = load_camera(file, name, **unit)
        camera = replace(camera, position=camera.position * scale)
        return resized(camera, height) if "height" in entries else camera
    width = table.whole("width", float(height))
    if "target" in entries:
        return look_at(table, width, height)
    return table.record(Camera, width=width, height=height)
