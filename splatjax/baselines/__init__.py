"""The methods that splat-based diffusion is measured against, and by what they are compared."""

from ._bust import bust_with_textures as bust_with_textures
from ._blending import BlendingRasterizer as BlendingRasterizer
from ._halves import half_and_half as half_and_half, HalfAndHalf as HalfAndHalf
from ._kernels import (
    AbstractKernel as AbstractKernel,
    DiscKernel as DiscKernel,
    DiscOrPixelKernel as DiscOrPixelKernel,
)
from ._kernels import EwaKernel as EwaKernel
from ._lighting import (
    LightAtPixels as LightAtPixels,
    normal_slopes as normal_slopes,
    NormalFields as NormalFields,
)
from ._measures import exitance as exitance, Off as Off, similarity as similarity
from ._mesh_light import (
    mesh_light as mesh_light,
    MeshLight as MeshLight,
    shadow_rooms as shadow_rooms,
)
from ._mesh_picture import TexturePlan as TexturePlan, TextureSpacePicture as TextureSpacePicture
from ._mesh_picture import (
    plan_texture_space as plan_texture_space,
    render_texture_space as render_texture_space,
)
from ._mesh_raster import (
    barycentrics as barycentrics,
    interpolate as interpolate,
    Landing as Landing,
)
from ._mesh_raster import room_for as room_for, see_faces as see_faces, SeenFaces as SeenFaces
from ._methods import (
    deferred_splatting as deferred_splatting,
    elliptical_points as elliptical_points,
)
from ._methods import ewa_splatting as ewa_splatting, phong_splatting as phong_splatting
from ._nearest import NearestRasterizer as NearestRasterizer
from ._screen_space import (
    AbstractScreenKernel as AbstractScreenKernel,
    diffuse_on_screen as diffuse_on_screen,
)
from ._screen_space import (
    GaussianPasses as GaussianPasses,
    PreintegratedKernel as PreintegratedKernel,
)
from ._screen_space import ShippedKernel as ShippedKernel
from ._texture_space import AbstractStretch as AbstractStretch, StretchCorrected as StretchCorrected
from ._texture_space import (
    TextureLayers as TextureLayers,
    TextureSpaceSettings as TextureSpaceSettings,
)
from ._texture_space import Uncorrected as Uncorrected
from ._texture_space import (
    diffuse_in_texture as diffuse_in_texture,
    lay_out as lay_out,
    look_up_layers as look_up_layers,
)
from ._texture_space import stretch_map as stretch_map
from ._textured_mesh import (
    look_up as look_up,
    surface_points as surface_points,
    TexturedMesh as TexturedMesh,
)
from ._thinned import ThinnedDiffuser as ThinnedDiffuser
from ._thinning import layer_contrast as layer_contrast, splats_that_suffice as splats_that_suffice
from ._thinning import thinning_error as thinning_error
from ._translucent import AbstractThinParts as AbstractThinParts, OpaqueParts as OpaqueParts
from ._translucent import TranslucentShadowMap as TranslucentShadowMap
