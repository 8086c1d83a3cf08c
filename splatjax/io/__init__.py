"""The only room that touches files: splats, meshes, pictures, materials."""

from ._atomic import atomic_path as atomic_path
from ._mesh import sample_mesh as sample_mesh
from ._ply import read_splats as read_splats, write_splats as write_splats
