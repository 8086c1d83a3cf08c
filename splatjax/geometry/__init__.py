"""Makes and completes splats: bust, mesh sampling, normals, radii, areas."""

from ._bust import bust as bust, bust_mesh as bust_mesh
from ._cells import tangent_frames as tangent_frames
from ._complete import complete_splats as complete_splats
from ._complexion import complexion as complexion
from ._creases import split_creases as split_creases
from ._cut import cut_below as cut_below
from ._places import distinct as distinct
from ._mesh import Mesh as Mesh, unit as unit, vertex_normals as vertex_normals
from ._normals import estimate_normals as estimate_normals
from ._sample import sample_mesh as sample_mesh
from ._textures import Textures as Textures
