"""splatjax: a differentiable renderer for translucent materials.

From a few optical coefficients to a translucent picture, and back; lengths in millimeters
throughout.
"""

from .fitting import (
    FitResult as FitResult,
    fit_gaussians as fit_gaussians,
    relative_error as relative_error,
    error_by_count as error_by_count,
    LeastCount as LeastCount,
    fit_weights as fit_weights,
    FreeWeights as FreeWeights,
    NonNegativeWeights as NonNegativeWeights,
    FixedTotalReflectance as FixedTotalReflectance,
    GivenVariances as GivenVariances,
    GreedyInsertion as GreedyInsertion,
    SharedVariances as SharedVariances,
    VariancesPerChannel as VariancesPerChannel,
)
from .gaussians import AbstractProfile as AbstractProfile, SumOfGaussians as SumOfGaussians
from .geometry import bust as bust, bust_mesh as bust_mesh
from .io import (
    read_exr as read_exr,
    read_splats as read_splats,
    sample_mesh as sample_mesh,
    SplatFile as SplatFile,
    write_exr as write_exr,
    write_png as write_png,
    write_splats as write_splats,
    dipole_starts as dipole_starts,
    load_material as load_material,
    load_medium as load_medium,
    load_profile as load_profile,
    read_observations as read_observations,
    read_profile as read_profile,
    list_materials as list_materials,
    save_material as save_material,
)
from .scattering import (
    BetterDipole as BetterDipole,
    Burley as Burley,
    Dipole as Dipole,
    PhotonBeam as PhotonBeam,
    EganFresnel as EganFresnel,
    ExactFresnel as ExactFresnel,
    Medium as Medium,
    Film as Film,
    Layer as Layer,
    LayeredMultipole as LayeredMultipole,
    Multipole as Multipole,
    InverseVariance as InverseVariance,
    L2_QUADRATURE as L2_QUADRATURE,
    RadialRule as RadialRule,
    SingleScattering as SingleScattering,
    Tabulated as Tabulated,
)
from .scene import (
    Camera as Camera,
    DirectionalLight as DirectionalLight,
    Frame as Frame,
    GaussianBeam as GaussianBeam,
    Material as Material,
    PointLight as PointLight,
    Scene as Scene,
    Splats as Splats,
)
from .transport import (
    DiffuseIncidence as DiffuseIncidence,
    NormalIncidence as NormalIncidence,
    HenyeyGreenstein as HenyeyGreenstein,
    Isotropic as Isotropic,
    monte_carlo as monte_carlo,
    MonteCarlo as MonteCarlo,
    path_derivatives as path_derivatives,
)

from .render import (
    compute_irradiance as compute_irradiance,
    diffuse_irradiance as diffuse_irradiance,
    diffusion_basis as diffusion_basis,
    DiffusionBasis as DiffusionBasis,
    illuminate as illuminate,
    make_plan as make_plan,
    map_over as map_over,
    picture_jacobian as picture_jacobian,
    PictureJacobian as PictureJacobian,
    Plan as Plan,
    render as render,
    render_streamed as render_streamed,
    RenderSettings as RenderSettings,
    SplatLight as SplatLight,
)

from .inverse import (
    HuberLoss as HuberLoss,
    SquaredLoss as SquaredLoss,
    KnownIntensity as KnownIntensity,
    UnknownColor as UnknownColor,
    UnknownIntensity as UnknownIntensity,
    Candidate as Candidate,
    next_pictures as next_pictures,
    default_candidates as default_candidates,
    AlbedoMap as AlbedoMap,
    CameraPoses as CameraPoses,
    LightPlaces as LightPlaces,
    LightStrengths as LightStrengths,
    NormalOffsets as NormalOffsets,
    BlackBackground as BlackBackground,
    UnknownBackground as UnknownBackground,
    fit_scene as fit_scene,
    FittedScene as FittedScene,
    combined as combined,
    Estimate as Estimate,
    Observation as Observation,
    recover as recover,
    Recovery as Recovery,
)

__version__ = "0.1.0"
