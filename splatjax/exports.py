"""Export of materials as parameters of other renderers: sums of Gaussians as a single length, as
screen-space kernels, and as plain numbers and text; materials as the subsurface of OpenPBR and of
glTF.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import HalfSpace, Medium, diffuse_scaling
from splatjax.scene import Material


def burley_distance(gaussians: SumOfGaussians) -> Float[Array, " channels"]:
    r"""Compute the length `d` with which normalized diffusion,
    `(exp(-r/d) + exp(-r/3d)) / (8 pi d r)`, has the same mean distance as the Gaussians. It is the
    scattering distance of Unity's HDRP, whose shape parameter is `1 / d`.

    The mean distance of normalized diffusion is `2.5 d`, and that of the Gaussians is
    `sum_i w_i sqrt(pi v_i / 2) / sum_i w_i`. The profiles differ, since normalized diffusion is
    infinite at the origin.

    **Arguments:**

    - `gaussians`: Differentiable.

    **Returns:** mm.

    **Source:** Christensen and Burley 2015 (profile); matching the mean distance is our own.
    """
    distances = jnp.sqrt(0.5 * jnp.pi * gaussians.variances)
    return distances @ gaussians.weights / (2.5 * gaussians.total_reflectance())


def blender_radius(gaussians: SumOfGaussians) -> Float[Array, " channels"]:
    r"""Compute the radius for Blender's method Christensen-Burley at scale 1, `4 pi s(A) d`, with
    the total reflectance A and the `d` of `burley_distance`.

    Cycles computes the mean free path `l = radius / (4 pi)` and then `d = l / s(A)`, with `s` for
    diffuse incident light (`diffuse_scaling`).

    **Returns:** mm; divide by 1000 for Blender's unit, the meter.

    **Source:** Blender Foundation, Cycles, `kernel/closure/bssrdf.h`; Christensen and Burley 2015,
    Eq. 6.
    """
    return 4 * jnp.pi * diffuse_scaling(gaussians.total_reflectance()) * burley_distance(gaussians)


def mean_free_path(material: Material, g: float = 0.0) -> Float[Array, " channels"]:
    r"""Compute the mean free path of a material, `1 / (sigma_a + sigma_s' / (1 - g))`.

    It is computed from the material's coefficients if there are any; for `g = 0` it is the reduced
    mean free path. Otherwise it is `s(A) d`, with the total reflectance A and the `d` of
    `burley_distance`, so that normalized diffusion is as wide as the Gaussians.

    **Returns:** mm.

    **Source:** Christensen and Burley 2015, Eq. 6 (`s` for diffuse incident light).
    """
    if material.medium is not None:
        return 1 / (material.medium.sigma_a + material.medium.sigma_s_prime / (1 - g))
    return blender_radius(material.gaussians) / (4 * jnp.pi)


def openpbr_subsurface(
    material: Material, g: float = 0.0
) -> dict[str, Float[Array, ""] | Float[Array, " channels"]]:
    r"""Compute the subsurface parameters of OpenPBR.

    With coefficients, this is the inverse of `HalfSpace.of_color`, which includes the light that
    the surface reflects back into the body. OpenPBR's own formula omits this reflection, and agrees
    to 0.6% for equal indices. Without coefficients, the color is the total reflectance.

    **Arguments:**

    - `material`: Differentiable.
    - `g`: mean cosine of the material's phase function (`io.load_mean_cosine`).

    **Returns:** `subsurface_color`, `subsurface_radius` (the largest mean free path, mm),
    `subsurface_radius_scale`, and `subsurface_scatter_anisotropy`, which is `g`.

    **Source:** Andersson et al. 2024, OpenPBR surface 1.1, "Subsurface".
    """
    color, medium = material.total_reflectance(), material.medium
    if medium is not None:
        white = Medium(jnp.zeros_like(medium.sigma_a), medium.sigma_s_prime, medium.eta)
        color = HalfSpace(medium, g).color() / HalfSpace(white, g).color()
    lengths = mean_free_path(material, g)
    radius = jnp.max(lengths)
    return {
        "subsurface_color": color,
        "subsurface_radius": radius,
        "subsurface_radius_scale": lengths / radius,
        "subsurface_scatter_anisotropy": jnp.full_like(radius, g),
    }


def gltf_volume(
    material: Material,
) -> tuple[Float[Array, ""], Float[Array, " channels"], Float[Array, " channels"]]:
    r"""Compute the volume parameters of a glTF material.

    Absorption and scattering both attenuate light. The multiple-scattering color of an albedo `a`
    is `((p - s)^2 - u) / (v - 2 q (p - s))` with `s = sqrt(1 - a)`, the inverse of
    `1 - (p + q c - sqrt(u + v c + q^2 c^2))^2`. Without coefficients it is the total reflectance.

    **Arguments:**

    - `material`: Differentiable.

    **Returns:** the attenuation distance, mm, the attenuation color, and the multiple-scattering
    color.

    **Source:** Khronos, KHR_materials_volume and the draft of KHR_materials_volume_scatter; Kulla
    and Conty 2017, "Revisiting Physically Based Shading at Imageworks" (formula).
    """
    color, medium, lengths = material.total_reflectance(), material.medium, mean_free_path(material)
    if medium is not None:
        p, q, u, v = 4.09712, 4.20863, 9.59217, 41.6808
        rest = p - jnp.sqrt(1 - medium.sigma_s_prime / medium.sigma_t_prime)
        color = (rest * rest - u) / (v - 2 * q * rest)
    distance = jnp.min(lengths)
    return distance, jnp.exp(-distance / lengths), color


@jit_unless_traced
def separable_kernel(
    gaussians: SumOfGaussians, samples: int = 25, reach: float | None = None
) -> tuple[Float[Array, " samples"], Float[Array, "samples channels"]]:
    r"""Compute a kernel for separable subsurface scattering, which blurs along each axis of the
    screen.

    Offsets are denser near the center: `reach sign(t) t^2` for equally spaced `t` from -1 to 1. A
    weight is the profile at the offset times half the distance between the neighboring offsets; the
    weights of a channel sum to 1. The two blurs together equal the radial profile only for a single
    Gaussian.

    **Arguments:**

    - `gaussians`: Differentiable.
    - `samples`: odd, at least 3.
    - `reach`: largest offset, mm; by default twice the root mean square distance per axis of the
      widest channel.

    **Returns:** the ascending offsets, mm, and their weights.

    **Raises:** `ValueError` for an even number of samples, or fewer than 3, and for a reach that is
    not positive.

    **Source:** Jimenez et al. 2015, "Separable subsurface scattering", and its published code.
    """
    if samples < 3 or samples % 2 == 0:
        raise ValueError(
            f"samples must be odd and at least 3, so that one is in the middle; got {samples}"
        )
    check_values("reach", reach, "positive (mm)", lambda x: x > 0)
    squared = gaussians.variances @ gaussians.weights / gaussians.total_reflectance()
    farthest = 2 * jnp.sqrt(jnp.max(squared)) if reach is None else reach
    t = jnp.linspace(-1.0, 1.0, samples, dtype=gaussians.variances.dtype)
    offsets = farthest * jnp.sign(t) * t * t
    steps = jnp.pad(jnp.diff(offsets), 1)
    weights = 0.5 * (steps[1:] + steps[:-1])[:, None] * gaussians(offsets)
    return offsets, weights / jnp.sum(weights, axis=0)[None]


def data_sheet(gaussians: SumOfGaussians) -> dict[str, Any]:
    r"""Compute all exports of a sum of Gaussians, each with its formula, unit and source, as lists,
    numbers and text.

    **Returns:** a dictionary for JSON with the entries `gaussians`, `gpu_gems`, `separable_kernel`,
    `burley`, `unity` and `blender`.
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
            "source": "Unity HDRP, DiffusionProfileSettings.UpdateKernel",
            "shape_parameter": plain_numbers(1 / burley_distance(gaussians)),
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
    """Convert numbers to the shortest Python numbers that restore them exactly."""
    values = np.asarray(values)
    if values.dtype == np.float32:
        # Not `str`, which shows six digits once colour-science is imported.
        shortest = [float(np.format_float_scientific(x)) for x in values.ravel()]
        return np.reshape(shortest, values.shape).tolist()
    return values.tolist()
