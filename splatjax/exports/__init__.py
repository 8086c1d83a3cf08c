"""A sum of Gaussians in the terms of other renderers."""

from ._burley import (
    blender_radius as blender_radius,
    burley_distance as burley_distance,
    unity_shape_parameter as unity_shape_parameter,
)
from ._kernels import separable_kernel as separable_kernel
from ._sheet import data_sheet as data_sheet, plain_numbers as plain_numbers
