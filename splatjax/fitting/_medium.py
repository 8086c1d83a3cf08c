"""From a measured profile back to optical coefficients."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from splatjax.gaussians import AbstractProfile
from splatjax.scattering import Dipole, Medium, Tabulated

from ._dense import NormalEquations, invert
from ._fit import fit_gaussians
from ._search import AbstractStart, GreedyInsertion
from ._spread import VariancesPerChannel

_TOLERANCE = 1e-7
_STEPS = 64


class MediumFit(eqx.Module):
    r"""A medium that explains a measured profile, and how well it is known.

    **Attributes:**

    - `medium`: the most likely one.
    - `covariance`: of the logarithms of `sigma_a` and `sigma_s_prime`, per channel: its diagonal
      holds squared relative errors.
    - `chi_squared`: sum of the squared residuals over their deviations, per degree of freedom:
      about 1 if the model holds and the deviations are right; above, the error bars are too small
      by its root.
    - `result`: what became of the search, as a message (`optimistix.RESULTS`).
    """

    medium: Medium
    covariance: Float[Array, "channels 2 2"]
    chi_squared: Float[Array, " channels"]
    result: optx.RESULTS


def fit_medium(
    measured: Tabulated,
    deviation: Float[Array, "samples channels"],
    start: Medium,
    *,
    beam_variance: float = 0.0,
    model: Callable[[Medium], AbstractProfile] = Dipole,
    count: int = 6,
    gaussians_start: AbstractStart | None = None,
    throw: bool = True,
) -> MediumFit:
    r"""Find the absorption and scattering that explain a measured profile: weighted least squares
    on its samples.

    The model goes the way of the picture: coefficients, profile, sum of Gaussians, the beam's
    variance added to each; it is differentiated through all of it. Channels are independent. Use
    double precision.

    **Arguments:**

    - `measured`: with its scale: exitance per unit power entering, 1/mm^2.
    - `deviation`: standard errors of its samples, 1/mm^2, positive.
    - `start`: where the search starts, within a factor of some ten; its `eta` is taken as known.
    - `beam_variance`: of the beam that made the dot, per axis, mm^2.
    - `model`: from a medium to its profile.
    - `count`: number of Gaussians.
    - `gaussians_start`: where their fits start; `GreedyInsertion()` by default.
    - `throw`: raise if the search has not converged; otherwise `result` says so.

    **Returns:** a `MediumFit`.

    **Raises:** `ValueError` for deviations that are not positive, and for shapes that do not match;
    an error with the message of `result` if `throw`.
    """
    if deviation.shape != measured.values.shape or start.eta.shape != measured.values.shape[1:]:
        shapes = f"{list(deviation.shape)} deviations, {start.eta.shape[0]} channels of start"
        raise ValueError(
            f"the profile has {list(measured.values.shape)} samples and channels; got {shapes}"
        )
    if not bool(jnp.all(deviation > 0)):
        raise ValueError(f"deviations must be positive (1/mm^2); got {float(jnp.min(deviation)):g}")
    gaussians_start = GreedyInsertion() if gaussians_start is None else gaussians_start
    fitted = _fit_compiled(
        measured, deviation, start, jnp.asarray(beam_variance), model, count, gaussians_start
    )
    return (
        fitted.result.error_if(fitted, fitted.result != optx.RESULTS.successful)
        if throw
        else fitted
    )


@eqx.filter_jit
def _fit_compiled(
    measured, deviation, start, beam_variance, model, count, gaussians_start
) -> MediumFit:
    def fit_channel(values, deviation, sigma_a, sigma_s_prime, eta):
        def residuals(point, _):
            moved = Medium(*(jnp.exp(each)[None] for each in point), eta[None])
            fitted = fit_gaussians(
                model(moved),
                count,
                spread=VariancesPerChannel(),
                start=gaussians_start,
                throw=False,
            )
            gaussians = jax.tree.map(lambda leaf: leaf[0], fitted.gaussians)
            return (gaussians.blurred(beam_variance)(measured.radii)[:, 0] - values) / deviation

        solver = optx.LevenbergMarquardt(
            rtol=_TOLERANCE, atol=_TOLERANCE, linear_solver=NormalEquations()
        )
        point = jnp.log(jnp.stack([sigma_a, sigma_s_prime]))
        found = optx.least_squares(residuals, solver, point, max_steps=_STEPS, throw=False)
        slopes, left = jax.jacfwd(lambda point: (residuals(point, None),) * 2, has_aux=True)(
            found.value
        )
        freedom = max(len(values) - len(point), 1)
        return (
            jnp.exp(found.value),
            invert(slopes.T @ slopes),
            left @ left / freedom,
            found.result == optx.RESULTS.successful,
        )

    fitted = jax.vmap(fit_channel)(
        measured.values.T, deviation.T, start.sigma_a, start.sigma_s_prime, start.eta
    )
    coefficients, covariance, chi_squared, converged = fitted
    result = optx.RESULTS.where(
        jnp.all(converged), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    return MediumFit(Medium(*coefficients.T, start.eta), covariance, chi_squared, result)
