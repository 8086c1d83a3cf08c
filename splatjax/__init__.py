"""splatjax: a differentiable renderer for translucent materials.

From a few optical coefficients to a translucent picture, and back; lengths in millimeters
throughout.
"""

from .fitting import (
    FitResult as FitResult,
    fit_gaussians as fit_gaussians,
    relative_error as relative_error,
)
from .fitting import error_by_count as error_by_count, LeastCount as LeastCount
from .fitting import fit_weights as fit_weights
from .fitting import FreeWeights as FreeWeights, NonNegativeWeights as NonNegativeWeights
from .fitting import TotalReflectanceHeld as TotalReflectanceHeld
from .fitting import GivenVariances as GivenVariances, InsertedGaussians as InsertedGaussians
from .fitting import SharedVariances as SharedVariances, VariancesPerChannel as VariancesPerChannel
from .gaussians import AbstractProfile as AbstractProfile, SumOfGaussians as SumOfGaussians
from .geometry import bust as bust, bust_mesh as bust_mesh
from .io import (
    read_exr as read_exr,
    read_splats as read_splats,
    sample_mesh as sample_mesh,
    SplatFile as SplatFile,
)
from .io import write_exr as write_exr, write_png as write_png, write_splats as write_splats
from .scattering import (
    BetterDipole as BetterDipole,
    Burley as Burley,
    Dipole as Dipole,
    PhotonBeam as PhotonBeam,
)
from .scattering import EganFresnel as EganFresnel, ExactFresnel as ExactFresnel, Medium as Medium
from .scattering import (
    Film as Film,
    Layer as Layer,
    LayeredMultipole as LayeredMultipole,
    Multipole as Multipole,
)
from .scattering import (
    InverseVariance as InverseVariance,
    NORM_RULE as NORM_RULE,
    RadialRule as RadialRule,
    SingleScattering as SingleScattering,
    Tabulated as Tabulated,
)
from .io import (
    dipole_starts as dipole_starts,
    load_material as load_material,
    load_medium as load_medium,
    load_profile as load_profile,
)
from .io import read_observations as read_observations, read_profile as read_profile
from .io import list_materials as list_materials, save_material as save_material
from .scene import Camera as Camera, DirectionalLight as DirectionalLight, Frame as Frame
from .scene import GaussianBeam as GaussianBeam, Material as Material, PointLight as PointLight
from .scene import Scene as Scene, Splats as Splats
from .transport import DiffuseIncidence as DiffuseIncidence, NormalIncidence as NormalIncidence
from .transport import HenyeyGreenstein as HenyeyGreenstein, Isotropic as Isotropic
from .transport import (
    monte_carlo as monte_carlo,
    MonteCarlo as MonteCarlo,
    path_derivatives as path_derivatives,
)

from .render import (
    gather_picture as gather_picture,
    gather_picture_and_slopes as gather_picture_and_slopes,
)
from .render import GatheredPicture as GatheredPicture
from .render import (
    diffuse as diffuse,
    picture_jacobian as picture_jacobian,
    PictureJacobian as PictureJacobian,
)
from .render import map_over as map_over, render_streamed as render_streamed
from .render import Plan as Plan, plan as plan, render as render, RenderSettings as RenderSettings

from .inverse import HuberLoss as HuberLoss, SquaredLoss as SquaredLoss
from .inverse import (
    KnownIntensity as KnownIntensity,
    UnknownColor as UnknownColor,
    UnknownIntensity as UnknownIntensity,
)
from .inverse import (
    Candidate as Candidate,
    next_pictures as next_pictures,
    usual_candidates as usual_candidates,
)
from .inverse import AlbedoMap as AlbedoMap, CameraPoses as CameraPoses, LightPlaces as LightPlaces
from .inverse import LightStrengths as LightStrengths, NormalOffsets as NormalOffsets
from .inverse import BlackBackground as BlackBackground, UnknownBackground as UnknownBackground
from .inverse import fit_scene as fit_scene, FittedScene as FittedScene
from .inverse import combined as combined, Estimate as Estimate
from .inverse import Observation as Observation, recover as recover, Recovery as Recovery

__version__ = "0.1.0"
