"""What a fit minimizes (Eq. 3) and what it reports (Eq. 4)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule, at_own_radii


def norm_radii(
    profile: AbstractProfile, rule: AbstractRadialRule
) -> tuple[Float[Array, "nodes channels"], Float[Array, "nodes channels"]]:
    """Compute radii and weights of integrals of `r R^2`, where the integral exists."""
    if profile.singular and rule.reaches_origin:
        raise ValueError(
            f"{type(profile).__name__} goes to infinity like 1/r, so that the integral of r R^2 "
            "from 0 (Eq. 3) does not exist; state where it starts, in length scales of the "
            "profile: rule=L2_QUADRATURE.beyond(1.0)"
        )
    return rule.radii(profile)


@jit_unless_traced
def squared_error(
    profile: AbstractProfile, gaussians: SumOfGaussians, rule: AbstractRadialRule = L2_QUADRATURE
) -> Float[Array, " channels"]:
    r"""Compute the error that a fit minimizes, the integral over r of `r (R(r) - sum_i w_i G(v_i,
    r))^2` (Eq. 3).

    **Arguments:**

    - `profile`: the reference, 1/mm^2. Differentiable.
    - `gaussians`: with as many channels. Differentiable.
    - `rule`: radii of the integral, in length scales of `profile`.

    **Returns:** [channels], 1/mm^2, at least 0.

    **Raises:** `ValueError` for a profile that is infinite at the origin, unless the rule starts
    beyond it.

    **Source:** Kim et al. 2010, Eq. 3 (d'Eon, Luebke and Enderton 2007).
    """
    r, dr = norm_radii(profile, rule)
    difference = at_own_radii(profile, r) - at_own_radii(gaussians, r)
    return jnp.sum(dr * r * difference * difference, axis=0)


@jit_unless_traced
def relative_error(
    profile: AbstractProfile, gaussians: SumOfGaussians, rule: AbstractRadialRule = L2_QUADRATURE
) -> Float[Array, " channels"]:
    r"""Compute the relative error of a fit: the root of Eq. 3 over that of the integral of `r R^2`
    (Eq. 4).

    It weights the core of a profile, hardly its tail: see `FitResult.energy_error` for the energy.

    **Arguments:** as for `squared_error`. Differentiable where the fit is not perfect.

    **Returns:** [channels], at least 0; it depends on neither the unit of length nor the scale of
    the profile.

    **Source:** Kim et al. 2010, Eq. 4.
    """
    r, dr = norm_radii(profile, rule)
    values = at_own_radii(profile, r)
    return jnp.sqrt(
        squared_error(profile, gaussians, rule) / jnp.sum(dr * r * values * values, axis=0)
    )
