"""A sum of Gaussians in the terms of other renderers."""

from ._exports import (
    blender_radius as blender_radius,
    burley_distance as burley_distance,
    data_sheet as data_sheet,
    plain_numbers as plain_numbers,
    separable_kernel as separable_kernel,
    unity_shape_parameter as unity_shape_parameter,
)
