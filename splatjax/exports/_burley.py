"""Renderers with normalized diffusion: one length stands for the whole profile."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import DiffuseTransmission


def burley_distance(gaussians: SumOfGaussians) -> Float[Array, " channels"]:
    r"""Compute the `d` of normalized diffusion, `(exp(-r/d) + exp(-r/3d)) / (8 pi d r)`, that sends
    light as far on average.

    Its mean distance is `2.5 d`; that of the Gaussians is `sum_i w_i sqrt(pi v_i / 2) / sum_i w_i`.
    The curves differ: normalized diffusion is infinite at the origin.

    **Arguments:**

    - `gaussians`: Differentiable.

    **Returns:** mm.

    **Source:** the profile is that of Christensen and Burley 2015; matching the mean distance is
    ours.
    """
    distances = jnp.sqrt(0.5 * jnp.pi * gaussians.variances)
    return distances @ gaussians.weights / (2.5 * gaussians.total_reflectance())


def unity_shape_parameter(gaussians: SumOfGaussians) -> Float[Array, " channels"]:
    r"""Compute the shape parameter `S = 1 / d` of Unity's High Definition Render Pipeline; its
    scattering distance is `d`.

    **Returns:** 1/mm: with a world scale of 1 (a unit is a meter) the pipeline counts `d` in mm.

    **Source:** Unity Technologies, Graphics repository, `DiffusionProfileSettings.UpdateKernel`.
    """
    return 1 / burley_distance(gaussians)


def blender_radius(gaussians: SumOfGaussians) -> Float[Array, " channels"]:
    r"""Compute the radius for Blender's method Christensen-Burley, at scale 1: `4 pi s(A) d`, where
    A is the total reflectance.

    Cycles takes a quarter of the radius over pi for the mean free path l, and then `d = l / s(A)`
    with the curve for diffuse transmission.

    **Returns:** mm; in Blender's unit of length, the meter, a thousandth of that.

    **Source:** Blender Foundation, Cycles, `kernel/closure/bssrdf.h`; Christensen and Burley 2015,
    Eq. 6.
    """
    return (
        4
        * jnp.pi
        * DiffuseTransmission()(gaussians.total_reflectance())
        * burley_distance(gaussians)
    )
