"""The only room that touches files: splats, meshes, pictures, materials."""

from ._animation import write_animation as write_animation
from ._atomic import atomic_path as atomic_path
from ._color import linear_to_srgb as linear_to_srgb, srgb_to_linear as srgb_to_linear
from ._exports import save_exports as save_exports
from ._exr import (
    read_exr as read_exr,
    read_manifest as read_manifest,
    read_picture as read_picture,
    write_exr as write_exr,
)
from ._materials import material_path as material_path
from ._materials import (
    load_material as load_material,
    load_medium as load_medium,
    load_profile as load_profile,
)
from ._materials import (
    materials as materials,
    profiles_folder as profiles_folder,
    save_material as save_material,
)
from ._materials import surface_and_source as surface_and_source
from ._media import join_tables as join_tables, read_column as read_column
from ._media import read_media as read_media, write_columns as write_columns
from ._mesh import (
    read_mesh as read_mesh,
    read_textured_mesh as read_textured_mesh,
    sample_mesh as sample_mesh,
)
from ._observations import picture_paths as picture_paths, read_observations as read_observations
from ._ply import read_splats as read_splats, write_splats as write_splats
from ._ply_parts import SplatFile as SplatFile
from ._png import write_png as write_png
from ._profiles import read_profile as read_profile
from ._record import (
    fingerprint as fingerprint,
    read_record as read_record,
    write_record as write_record,
)
from ._room import check_room as check_room, free_bytes as free_bytes
from ._starts import dipole_starts as dipole_starts
from ._version import own_version as own_version
