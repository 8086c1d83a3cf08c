"""Making and completing splats: the bust, mesh sampling, normals, radii and areas."""

from ._bust import bust as bust, bust_mesh as bust_mesh, complexion as complexion
from ._mesh import (
    cut_below as cut_below,
    distinct as distinct,
    Mesh as Mesh,
    split_creases as split_creases,
    unit as unit,
    vertex_normals as vertex_normals,
)
from ._normals import estimate_normals as estimate_normals
from ._sample import (
    complete_splats as complete_splats,
    sample_mesh as sample_mesh,
    Textures as Textures,
)
from ._scatter import tangent_frames as tangent_frames
