"""Reading and writing of splats, meshes, pictures, scenes and materials."""

from splatjax._display import (
    linear_to_srgb as linear_to_srgb,
    srgb_to_linear as srgb_to_linear,
)

from ._animations import write_animation as write_animation
from ._files import (
    atomic_path as atomic_path,
    fingerprint as fingerprint,
    naming as naming,
    read_record as read_record,
    save_exports as save_exports,
    write_record as write_record,
)
from ._images import (
    read_exr as read_exr,
    read_picture as read_picture,
    write_exr as write_exr,
    write_png as write_png,
)
from ._materials import (
    list_materials as list_materials,
    load_material as load_material,
    load_mean_cosine as load_mean_cosine,
    load_medium as load_medium,
    load_profile as load_profile,
    load_skin as load_skin,
    material_path as material_path,
    plain_material as plain_material,
    profiles_folder as profiles_folder,
    save_material as save_material,
    surface_and_source as surface_and_source,
)
from ._media import dipole_starts as dipole_starts
from ._spectra import (
    illuminant as illuminant,
    picture_to_rgb as picture_to_rgb,
    spectrum_to_rgb as spectrum_to_rgb,
)
from ._tables import (
    read_columns as read_columns,
    read_media as read_media,
    read_profile as read_profile,
    write_columns as write_columns,
    write_toml as write_toml,
)
from ._cameras import (
    load_camera as load_camera,
    load_cameras as load_cameras,
    resized as resized,
)
from ._gltf import save_gltf as save_gltf
from ._materialx import save_materialx as save_materialx
from ._meshes import read_textured_mesh as read_textured_mesh, sample_mesh as sample_mesh
from ._lights import (
    ENVIRONMENTS as ENVIRONMENTS,
    load_environment as load_environment,
    load_lights as load_lights,
    plain_light as plain_light,
    picture_paths as picture_paths,
    read_observations as read_observations,
)
from ._scenes import (
    DIFFUSERS as DIFFUSERS,
    load_scene as load_scene,
    material_of_scene as material_of_scene,
    mesh_of_scene as mesh_of_scene,
    plain_scene as plain_scene,
    read_manifest as read_manifest,
    scene_table as scene_table,
    save_scene as save_scene,
)
from ._ply import (
    SplatFile as SplatFile,
    read_splats as read_splats,
    write_splats as write_splats,
)
from ._usd import save_usd as save_usd
