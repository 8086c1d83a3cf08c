"""Fits of many media by one program, for `splatjax fit --all`."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import splatjax as sj

from ._models import MEDIUM_WEIGHTS

BATCH = 500  # media in one call


@eqx.filter_jit
def _fit_each(
    coefficients: Float[Array, "media 3"],
    starts: sj.fitting.DipoleStarts,
    count: int,
    model: sj.fitting.AbstractModel,
):
    def fit(row):
        medium = sj.Medium(row[0:1], row[1:2], row[2:3])
        fitted = sj.fit_gaussians(
            model.profile(medium),
            count,
            start=sj.fitting.GivenVariances(starts(medium, count).variances[0]),
            weights=MEDIUM_WEIGHTS,
            rule=model.rule,
            throw=False,
        )
        return fitted, model.angles(medium), fitted.result == optx.RESULTS.successful

    return eqx.filter_vmap(fit)(coefficients)


def fit_batch(
    coefficients: np.ndarray, count: int, model: sj.fitting.AbstractModel
) -> dict[str, np.ndarray]:
    """Return the columns of a batch. A smaller batch is padded, so that one program serves all. The
    starts of fits to dipoles are near the optima of other models of the same media.
    """
    given = len(coefficients)
    padded = np.pad(coefficients, ((0, BATCH - given), (0, 0)), mode="edge")
    fitted, angles, converged = _fit_each(jnp.asarray(padded), sj.io.dipole_starts(), count, model)
    powers = [] if angles is None else angles.coefficients[..., 0].T
    columns = {
        **dict(zip(("sigma_a", "sigma_s_prime", "eta"), padded.T, strict=True)),
        **{f"variance_{i + 1}": fitted.gaussians.variances[:, i] for i in range(count)},
        **{f"weight_{i + 1}": fitted.gaussians.weights[:, i, 0] for i in range(count)},
        **{f"angles_{power}": column for power, column in enumerate(powers)},
        "error": fitted.error[:, 0],
        "energy_error": fitted.energy_error[:, 0],
        "converged": converged.astype(float),
    }
    return {name: np.asarray(column)[:given] for name, column in columns.items()}
