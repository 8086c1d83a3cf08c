"""How fast fits are, beside SciPy: `python -m benchmarks.fits`. Both are warm; compile times are
given apart.

SciPy's `least_squares` (MINPACK) gets the same residuals, their exact Jacobian, and the same start.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

import splatjax as sj
from splatjax.fitting._problem import FitProblem, make_problem

COUNT = 6
TOLERANCE = 1e-12
PUSHED = np.array([0.5, -0.4, 0.3, -0.5, 0.4, -0.3])  # log variances of the start, off the optimum


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fits", description=__doc__)
    parser.add_argument(
        "--media", type=int, default=1000, help="random ones, in one call (default %(default)s)"
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="medians are given (default %(default)s)"
    )
    return parser.parse_args()


@eqx.filter_jit
def residuals(problem: FitProblem, point):
    return problem.residuals(point)[0]


@eqx.filter_jit
def jacobian(problem: FitProblem, point):
    return problem.expand(point).jacobian[0]


def scipy_fit(problem: FitProblem, start: np.ndarray):
    """The error (Eq. 4) that SciPy reaches."""
    found = least_squares(
        lambda point: np.asarray(residuals(problem, point)),
        start,
        jac=lambda point: np.asarray(jacobian(problem, point)),
        method="lm",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
    )
    return np.sqrt(2 * found.cost)


def timed(function, repeats: int):
    """Give the result, the median time (s) of warm calls, and that of the first."""
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return result, float(np.median(times[1:])), times[0]


def one_material(repeats: int) -> None:
    marble = sj.load_medium("marble")
    profile = sj.Dipole(jax.tree.map(lambda leaf: leaf[1:2], marble))
    best = sj.fit_gaussians(profile, COUNT)
    problem = make_problem(profile, sj.FreeWeights(), sj.L2_QUADRATURE)
    start = jnp.log(best.gaussians.variances) + PUSHED
    given = sj.GivenVariances(jnp.exp(start))
    ours, seconds, first = timed(lambda: sj.fit_gaussians(profile, COUNT, start=given), repeats)
    theirs, scipy_seconds, _ = timed(
        lambda: scipy_fit(problem, np.asarray(start - jnp.log(problem.squared_unit))), repeats
    )
    search, search_seconds, search_first = timed(lambda: sj.fit_gaussians(profile, COUNT), repeats)
    print(
        f"green marble, {COUNT} Gaussians, one start: {1e3 * seconds:.2f} ms, SciPy "
        f"{1e3 * scipy_seconds:.2f} ms;",
        end=" ",
    )
    print(f"E {float(ours.error[0]):.6e} and {float(theirs):.6e}; first call {first:.1f} s")
    print(
        f"  by the full search: {1e3 * search_seconds:.1f} ms, E {float(search.error[0]):.6e}; "
        f"first call {search_first:.1f} s"
    )


def many_media(count: int, repeats: int) -> None:
    noise = np.random.default_rng(0)
    albedo, sigma_t = 1 - 10 ** noise.uniform(-4, -0.02, count), 10 ** noise.uniform(-1, 1.3, count)
    coefficients = ((1 - albedo) * sigma_t, albedo * sigma_t, noise.uniform(1.0, 1.8, count))
    media = jax.vmap(sj.Medium)(*(jnp.asarray(each)[:, None] for each in coefficients))
    starts = sj.dipole_starts()

    def fit(medium):
        return sj.fit_gaussians(
            sj.Dipole(medium),
            COUNT,
            start=sj.GivenVariances(starts(medium, COUNT).variances[0]),
            throw=False,
        )

    batched = eqx.filter_jit(eqx.filter_vmap(fit))
    fitted, seconds, first = timed(lambda: batched(media), repeats)
    few = range(0, count, max(count // 50, 1))
    theirs = []
    for i in few:
        medium = jax.tree.map(lambda leaf, i=i: leaf[i], media)
        problem = make_problem(sj.Dipole(medium), sj.FreeWeights(), sj.L2_QUADRATURE)
        start = np.asarray(problem.log_variances(starts(medium, COUNT).variances[0]))
        theirs.append(timed(lambda problem=problem, start=start: scipy_fit(problem, start), 1)[:2])
    ratio = max(
        float(fitted.error[i, 0]) / float(error) for i, (error, _) in zip(few, theirs, strict=True)
    )
    scipy_seconds = float(np.median([seconds for _, seconds in theirs]))
    print(
        f"{count} media in one call: {1e3 * seconds / count:.2f} ms each, SciPy "
        f"{1e3 * scipy_seconds:.2f} ms;",
        end=" ",
    )
    print(f"worst E over SciPy's {ratio:.6f}; first call {first:.1f} s")


def main() -> None:
    chosen = arguments()
    with jax.enable_x64(True):
        one_material(chosen.repeats)
        many_media(chosen.media, min(chosen.repeats, 3))


if __name__ == "__main__":
    main()
