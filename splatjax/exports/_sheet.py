"""Everything at once, as plain numbers and words."""

from typing import Any

import numpy as np

from splatjax.gaussians import SumOfGaussians

from ._burley import blender_radius, burley_distance, unity_shape_parameter
from ._kernels import separable_kernel


def data_sheet(gaussians: SumOfGaussians) -> dict[str, Any]:
    r"""Express a sum of Gaussians in all the terms of this package, each with its formula, unit and
    source: lists, numbers and text.

    **Returns:** a dictionary that JSON can hold, with the entries `gaussians`, `gpu_gems`,
    `separable_kernel`, `burley`, `unity` and `blender`.
    """
    offsets, weights = separable_kernel(gaussians)
    return {
        "gaussians": {
            "formula": "R(r) = sum_i w_i exp(-r^2 / (2 v_i)) / (2 pi v_i)",
            "unit": (
                "variances in mm^2 per axis; R in 1/mm^2; a row of weights per "
                "Gaussian, a number per channel"
            ),
            "source": "d'Eon, Luebke and Enderton 2007",
            "variances": plain_numbers(gaussians.variances),
            "weights": plain_numbers(gaussians.weights),
            "total_reflectance": plain_numbers(gaussians.total_reflectance()),
        },
        "gpu_gems": {
            "formula": "weights divided by their sum per channel: the color comes from the texture",
            "unit": "variances in mm^2 per axis",
            "source": "d'Eon and Luebke 2007, GPU Gems 3, chapter 14",
            "variances": plain_numbers(gaussians.variances),
            "weights": plain_numbers(gaussians.white().weights),
        },
        "separable_kernel": {
            "formula": (
                "w_j = R(x_j) (x_(j+1) - x_(j-1)) / 2, divided by their sum per "
                "channel; blurred along x, then along y"
            ),
            "unit": "offsets in mm",
            "source": "Jimenez et al. 2015, Separable subsurface scattering",
            "offsets": plain_numbers(offsets),
            "weights": plain_numbers(weights),
        },
        "burley": {
            "formula": (
                "R(r) = A (exp(-r / d) + exp(-r / 3d)) / (8 pi d r); d = mean distance / 2.5"
            ),
            "unit": "d in mm",
            "source": "Christensen and Burley 2015; d matches the mean distance",
            "albedo": plain_numbers(gaussians.total_reflectance()),
            "d": plain_numbers(burley_distance(gaussians)),
        },
        "unity": {
            "formula": "S = 1 / d; scattering distance d",
            "unit": "S in 1/mm, d in mm, at a world scale of 1",
            "source": "Unity HDRP, DiffusionProfileSettings",
            "shape_parameter": plain_numbers(unity_shape_parameter(gaussians)),
            "scattering_distance": plain_numbers(burley_distance(gaussians)),
        },
        "blender": {
            "formula": "radius = 4 pi s(A) d with s(A) = 1.9 - A + 3.5 (A - 0.8)^2",
            "unit": "mm, at scale 1; a thousandth of it in Blender's meters",
            "source": (
                "Blender, Cycles, bssrdf.h, method Christensen-Burley; Christensen "
                "and Burley 2015, Eq. 6"
            ),
            "radius": plain_numbers(blender_radius(gaussians)),
        },
    }


def plain_numbers(values: Any) -> Any:
    """Convert to the shortest Python numbers that are read back exactly."""
    values = np.asarray(values)
    if values.dtype == np.float32:
        # Not `str`, which shows six digits once colour-science has been imported.
        return np.vectorize(lambda x: float(np.format_float_scientific(x)), otypes=[object])(
            values
        ).tolist()
    return values.tolist()
