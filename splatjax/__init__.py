"""splatjax: a differentiable renderer for translucent materials.

From a few optical coefficients to a translucent picture, and back; lengths in millimetres throughout.
"""

from .gaussians import AbstractProfile as AbstractProfile, SumOfGaussians as SumOfGaussians
from .scattering import Medium as Medium
from .scene import Camera as Camera, DirectionalLight as DirectionalLight, Frame as Frame
from .scene import GaussianBeam as GaussianBeam, Material as Material, PointLight as PointLight
from .scene import Scene as Scene, Splats as Splats

__version__ = "0.1.0"
