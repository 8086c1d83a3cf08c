"""Methods for comparison with splat-based diffusion, and measures of the comparison."""

from ._bust import bust_with_textures as bust_with_textures
from ._blending import BlendingRasterizer as BlendingRasterizer
from ._kernels import (
    AbstractSplatKernel as AbstractSplatKernel,
    DiscKernel as DiscKernel,
    DiscOrPixelKernel as DiscOrPixelKernel,
    EwaKernel as EwaKernel,
)
from ._lighting import (
    LightAtPixels as LightAtPixels,
    normal_slopes as normal_slopes,
    NormalFields as NormalFields,
    PhongSplats as PhongSplats,
)
from ._mesh_light import (
    mesh_light as mesh_light,
    MeshLight as MeshLight,
    shadow_capacities as shadow_capacities,
)
from ._mesh_picture import (
    plan_texture_space as plan_texture_space,
    render_texture_space as render_texture_space,
    TexturePlan as TexturePlan,
    TextureSpacePicture as TextureSpacePicture,
)
from ._mesh_raster import (
    barycentrics as barycentrics,
    capacity_for as capacity_for,
    interpolate as interpolate,
    Landing as Landing,
    see_faces as see_faces,
    SeenFaces as SeenFaces,
)
from ._methods import (
    deferred_splatting as deferred_splatting,
    elliptical_points as elliptical_points,
    exitance as exitance,
    ewa_splatting as ewa_splatting,
    phong_splatting as phong_splatting,
)
from ._nearest import NearestRasterizer as NearestRasterizer
from ._screen_space import (
    AbstractScreenKernel as AbstractScreenKernel,
    diffuse_on_screen as diffuse_on_screen,
    GaussianPasses as GaussianPasses,
    PreintegratedKernel as PreintegratedKernel,
    ShippedKernel as ShippedKernel,
)
from ._texture_space import (
    AbstractStretch as AbstractStretch,
    diffuse_in_texture as diffuse_in_texture,
    look_up_layers as look_up_layers,
    rasterize_in_texture as rasterize_in_texture,
    stretch_map as stretch_map,
    StretchCorrected as StretchCorrected,
    TextureLayers as TextureLayers,
    TextureSpaceSettings as TextureSpaceSettings,
    Uncorrected as Uncorrected,
)
from ._textured_mesh import (
    look_up as look_up,
    surface_points as surface_points,
    TexturedMesh as TexturedMesh,
)
from ._thinning import (
    layer_contrast as layer_contrast,
    splats_that_suffice as splats_that_suffice,
    ThinnedDiffuser as ThinnedDiffuser,
    thinning_error as thinning_error,
)
from ._translucent import (
    AbstractThinParts as AbstractThinParts,
    OpaqueParts as OpaqueParts,
    TranslucentShadowMap as TranslucentShadowMap,
)
