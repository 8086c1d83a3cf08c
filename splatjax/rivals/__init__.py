"""The methods that the paper measures itself against. They are given to the same renderer as objects."""

from ._blending import BlendingRasterizer as BlendingRasterizer
from ._kernels import AbstractKernel as AbstractKernel, DiscKernel as DiscKernel, DiscOrPixelKernel as DiscOrPixelKernel
from ._kernels import EwaKernel as EwaKernel
from ._lighting import LightAtPixels as LightAtPixels, normal_slopes as normal_slopes, NormalFields as NormalFields
from ._methods import deferred_splatting as deferred_splatting, elliptical_points as elliptical_points
from ._methods import ewa_splatting as ewa_splatting, phong_splatting as phong_splatting
from ._nearest import NearestRasterizer as NearestRasterizer
from ._thinned import ThinnedDiffuser as ThinnedDiffuser
from ._thinning import layer_contrast as layer_contrast, splats_that_suffice as splats_that_suffice
from ._thinning import thinning_error as thinning_error
