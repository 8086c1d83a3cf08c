"""The weights of Gaussians whose variances are given: the linear half of a fit."""

import jax

from splatjax._records import Numbers, as_floats
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

from ._problem import make_problem
from ._weights import AbstractWeights, FreeWeights


def fit_weights(
    profile: AbstractProfile,
    variances: Numbers,
    *,
    weights: AbstractWeights = FreeWeights(),
    rule: AbstractRadialRule = L2_QUADRATURE,
) -> SumOfGaussians:
    r"""Fit the weights of Gaussians of given variances to a profile: the least Eq. 3 over the
    weights alone.

    No search, hence fast. Variances that ascend by a factor of 3 over all widths of the dipoles of
    many media leave each an error (Eq. 4) of about 0.2%, by a factor of 2 of 0.002%: layers that
    are rendered once serve all of these media.

    **Arguments:**

    - `profile`: 1/mm^2. Differentiable, in forward and reverse mode.
    - `variances`: mm^2, positive, all different. Constants of every derivative.
    - `weights`: `FreeWeights()` (default), `FixedTotalReflectance()`, or `NonNegativeWeights()`
      among either.
    - `rule`: radii of the integral, in length scales of the profile.

    **Returns:** the Gaussians, in the profile's precision; with the variances of a fit they are
    those of the fit.

    **Raises:** `ValueError` for a profile that is infinite at the origin unless the rule starts
    beyond it.
    """
    problem = make_problem(profile, weights, rule)
    variances = jax.lax.stop_gradient(as_floats(variances, problem.target.dtype))
    return SumOfGaussians(variances, problem.best_weights(problem.log_variances(variances)))
