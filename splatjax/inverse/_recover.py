"""Recovery of coefficients from pictures of a known shape, and a ranking of further pictures."""

import warnings
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax._format import counted, format_numbers, percent
from splatjax._records import check_values, require
from splatjax.diffusion import ClusterDiffuser
from splatjax.fitting import (
    AbstractModel,
    AbstractWeights,
    FixedTotalReflectance,
    NonNegativeWeights,
    TransportModel,
    fit_gaussians,
    fit_weights,
)
from splatjax.gaussians import SumOfGaussians
from splatjax.render import RenderSettings
from splatjax.scattering import Medium
from splatjax.scene import Material, Splats

from ._observation import (
    AbstractLoss,
    Candidate,
    Evidence,
    Observation,
    PicturedScene,
    SquaredLoss,
    check_channels,
    compared,
)
from ._problem import (
    RecoveryProblem,
    Unknowns,
    fit_near,
    render_layers,
    search,
    solution,
    wide_variances,
)
from ._recovery import Combination, Recovery, best_and_worst, inverse

_FINE = RenderSettings(diffuser=ClusterDiffuser(error=2.5e-4))
_ROUNDS = 8
_SAME_INDEX = 1e-4
# Rounds end if no coefficient changes by more than this, or by more than a tenth of its error bar.
_SETTLED = 1e-3


def recover(
    observations: Sequence[Observation],
    splats: Splats,
    starts: Medium | Sequence[Medium],
    *,
    surface: Material | None = None,
    model: AbstractModel = TransportModel(),
    count: int = 6,
    weights: AbstractWeights = NonNegativeWeights(FixedTotalReflectance()),
    loss: AbstractLoss = SquaredLoss(),
    settings: RenderSettings = _FINE,
    progress: Callable[[str, Medium], None] | None = None,
) -> Recovery:
    r"""Recover the absorption and reduced scattering of a material from pictures of a known shape.

        seen = Observation(picture, camera, lights, deviation=noise)
        recovery = recover([seen], splats, load_medium("skin1"))
        print(recovery.summary())  # coefficients, error bars, and what is not determined

    Give a start within a factor of three of both coefficients, or several starts. The error bars
    assume that shape, lights, camera and model are exact; compare `recovery.chi_squared` with 1.

    The search is a weighted least-squares fit to all pixels at once, which differentiates the
    pictures with respect to the coefficients. The expensive layers depend only on the variances of
    the Gaussians, and are rendered once for many Levenberg-Marquardt steps. In the first round the
    variances are fixed (`wide_variances`). Each further round fits `count` Gaussians to the current
    coefficients, renders their layers and the derivatives with respect to the variances, and
    searches again, until the coefficients no longer change.

    **Arguments:**

    - `observations`: one or more.
    - `splats`: the splats of the body, mm. Their albedo is assumed known; without albedo the
      coefficients alone determine the color.
    - `starts`: starts of the search, with equal, known `eta`. Only the search with the least loss
      is continued.
    - `surface`: a material with the known specular strength and roughness, and the index of the
      starts; its Gaussians are not used. By default there is no specular lobe.
    - `model`: `TransportModel()`, by default, or `DiffusionModel()`, the classical dipole.
    - `count`: number of Gaussians; `weights`: the constraint on their weights, by default
      non-negative with a fixed sum, as for the materials of the library.
    - `loss`: `SquaredLoss()`, or `HuberLoss()` if the model does not explain some pixels.
    - `settings`: settings of the renderer, by default with layers eight times more accurate than in
      `render`: an error of 0.1% in a picture of a bright material is one of 2% in absorption.
    - `progress`: called with a description of each stage, and the best medium so far.

    **Returns:** a `Recovery` in JAX's default precision; `jax.enable_x64` resolves small errors. If
    the rounds do not converge, it is the recovery of the round with the least loss, which `result`
    and a `RuntimeWarning` report. To continue, start from its `medium`.

    **Raises:** `ValueError` without observations or starts, for unequal numbers of channels, for
    starts without absorption, for different indices of surface and starts, and for a picture
    without pixels that count.
    """
    dtype, observations = jnp.result_type(float), list(observations)
    starts = [
        jax.tree.map(lambda leaf: leaf.astype(dtype), start)
        for start in ([starts] if isinstance(starts, Medium) else starts)
    ]
    require(
        isinstance(model, AbstractModel),
        f"model is {model!r}; give TransportModel() or DiffusionModel(profile)",
    )
    _check(observations, splats, starts, surface)
    report = progress or (lambda stage, medium: None)
    eta, channels = starts[0].eta, starts[0].channels
    pictured_scenes = [PicturedScene(splats, view.camera, view.lights) for view in observations]
    evidence = [Evidence.of(observation, dtype) for observation in observations]
    unknowns = Unknowns.of(eta, [observation.intensity for observation in observations])
    noise_is_known = all(observation.deviation is not None for observation in observations)
    wide = wide_variances(starts, splats)
    surface = surface or Material(_unweighed(wide, channels), eta=eta[0], specular=0)

    def problem_at(medium, variances, fit, plans=None, derivative=True):
        material = surface.surface_of(_unweighed(variances, channels), model.angles(medium))
        pictures, plans = render_layers(pictured_scenes, material, settings, plans, derivative)
        return RecoveryProblem.of(pictures, evidence, unknowns, fit, loss, model), plans

    report(f"rendering {len(wide)} layers of {counted(len(observations), 'picture')}", starts[0])
    fit = eqx.Partial(fit_weights, variances=wide, weights=weights, rule=model.rule)
    problem, _ = problem_at(starts[0], wide, fit, derivative=False)
    report(
        f"searching from {counted(len(starts), 'start')} among {problem.pixels} pixels", starts[0]
    )
    ends = [search(problem, unknowns.start(start)) for start in starts]
    points, costs, steps, _ = zip(*ends, strict=True)
    costs = np.nan_to_num(np.asarray(costs, float), nan=np.inf)
    point, steps = points[int(np.argmin(costs))], sum(map(int, steps))
    settled, plans, rounds, best = False, None, 0, None
    while not settled and rounds < _ROUNDS:
        rounds += 1
        medium = unknowns.medium(point)
        report(
            f"round {rounds} of at most {_ROUNDS}: rendering the {count} layers of sigma_a "
            f"{format_numbers(medium.sigma_a, '.3g')}, sigma_s' "
            f"{format_numbers(medium.sigma_s_prime, '.3g')}",
            medium,
        )
        profile, rule = model.profile(medium), model.rule
        near = fit_gaussians(profile, count, weights=weights, rule=rule, throw=False).gaussians
        fit = eqx.Partial(fit_near, near=near.variances, weights=weights, rule=rule)
        problem, plans = problem_at(medium, near.variances, fit, plans)
        before = point
        point, cost, steps_taken, converged = search(problem, before)
        steps += int(steps_taken)
        information, unresolved, gaussians, radiance = solution(problem, point)
        chi_squared = cost / max(problem.pixels * channels - point.size, 1)
        covariance = inverse(np.asarray(information, np.float64)[: point.size, : point.size])
        scale = 1.0 if noise_is_known else float(chi_squared) ** 0.5
        deviations = scale * np.sqrt(np.diagonal(covariance))
        moved = np.abs(point - before)
        settled = bool(converged) and np.all(moved <= np.maximum(_SETTLED, 0.1 * deviations))
        if settled or best is None or float(chi_squared) <= float(best.chi_squared):
            pictures, residuals = compared(radiance, problem.counted, evidence)
            best = Recovery(
                medium=unknowns.medium(point),
                material=surface.surface_of(gaussians, model.angles(unknowns.medium(point))),
                intensities=unknowns.intensities(point),
                information=information,
                unresolved=unresolved,
                chi_squared=chi_squared,
                pictures=pictures,
                residuals=residuals,
                ends=tuple(map(unknowns.medium, points)),
                costs=jnp.asarray(costs, dtype),
                result=optx.RESULTS.where(
                    jnp.asarray(settled),
                    optx.RESULTS.successful,
                    optx.RESULTS.nonlinear_max_steps_reached,
                ),
                noise_is_known=noise_is_known,
                relative_noise=float(np.mean([observed.relative_noise for observed in evidence])),
                steps=steps,
                rounds=rounds,
                model=model,
                weights=weights,
            )
    assert best is not None
    if not settled:
        warnings.warn(
            f"the coefficients still changed in the last round ({rounds}), so this is the "
            "round with the least loss; start from its medium to continue",
            RuntimeWarning,
            stacklevel=2,
        )
    return best


def _check(observations: list[Observation], splats, starts: list[Medium], surface) -> None:
    require(
        observations and starts,
        f"at least one observation and one start are needed; got {len(observations)} and "
        f"{len(starts)}",
    )
    eta = starts[0].eta
    for i, start in enumerate(starts):
        require(
            np.array_equal(start.eta, eta),
            f"starts[{i}].eta is {start.eta.tolist()}, and that of the first {eta.tolist()}; give "
            "all the same index",
        )
        check_values(
            f"starts[{i}].sigma_a",
            start.sigma_a,
            "above 0, because logarithms are searched; use 1e-4 for a small one",
            lambda x: x > 0,
        )
    if surface is not None and not np.allclose(surface.eta, eta, rtol=_SAME_INDEX):
        raise ValueError(
            f"surface.eta is {float(surface.eta):g}, starts[0].eta {eta.tolist()}: recover "
            "needs one known index of refraction; give both the same"
        )
    check_channels(observations, starts[0].channels, "starts")
    if splats.albedo is not None and splats.albedo.shape[1] != starts[0].channels:
        raise ValueError(
            f"splats.albedo has {splats.albedo.shape[1]} channels, starts have {starts[0].channels}"
        )


def _unweighed(variances: Float[Array, " gaussians"], channels: int) -> SumOfGaussians:
    """Make Gaussians with placeholder weights."""
    return SumOfGaussians(variances, jnp.zeros((len(variances), channels), variances.dtype))


class Prediction(eqx.Module):
    r"""The predicted error bars after one more picture.

    **Attributes:**

    - `candidate`: the picture.
    - `covariance`: covariance of the logarithms of `sigma_a` and `sigma_s_prime` of each channel
      if this picture is added.
    """

    candidate: Candidate
    covariance: Float[np.ndarray, "channels 2 2"]

    @property
    def worst(self) -> Combination:
        """Return the combination with the largest error in any channel."""
        worst = (best_and_worst(covariance)[1] for covariance in self.covariance)
        return max(worst, key=lambda combination: combination.deviation)

    def __str__(self) -> str:
        name, deviation = self.candidate.name, percent(self.worst.deviation)
        return f"{name}: the least known combination, {self.worst}, would be known to {deviation}"


def next_pictures(
    recovery: Recovery,
    splats: Splats,
    candidates: Sequence[Candidate],
    *,
    settings: RenderSettings = RenderSettings(),
) -> list[Prediction]:
    r"""Rank candidate pictures by the error bars that the coefficients would have with each
    picture.

    Each candidate is rendered once with the recovered material and differentiated. Its noise,
    relative to its brightness, is that of the earlier pictures. The covariance is the inverse of
    the summed information.

    **Arguments:**

    - `recovery`: the recovery from the earlier pictures; its model and weights are used.
    - `splats`: the splats of the body.
    - `candidates`: at least one; see `default_candidates`.
    - `settings`: settings of the renderer, by default those of `render`, since a prediction needs
      less accurate layers than a search.

    **Returns:** the predictions, in ascending order of the error of their worst combination.

    **Raises:** `ValueError` without candidates, and for a candidate in which the body is not
    visible.
    """
    candidates = list(candidates)
    require(candidates, "candidates is empty; give some, or default_candidates(splats, camera)")
    medium, dtype = recovery.medium, recovery.medium.eta.dtype
    pictured_scenes = [PicturedScene(splats, view.camera, view.lights) for view in candidates]
    pictures, _ = render_layers(pictured_scenes, recovery.material, settings)
    near = recovery.material.gaussians.variances.astype(dtype)
    fit = eqx.Partial(fit_near, near=near, weights=recovery.weights, rule=recovery.model.rule)
    noise = recovery.relative_noise * recovery.scale**0.5
    predictions = []
    for candidate, picture in zip(candidates, pictures, strict=True):
        dark = np.zeros(picture.specular.shape)
        observation = Observation(dark, candidate.camera, candidate.lights, deviation=1)
        unknowns = Unknowns.of(medium.eta, [candidate.intensity])
        evidence = [Evidence.of(observation, dtype)]
        problem = RecoveryProblem.of(
            [picture], evidence, unknowns, fit, SquaredLoss(), recovery.model
        )
        information, _, _, (radiance,) = solution(problem, unknowns.start(medium))
        radiance = np.asarray(radiance)[np.asarray(problem.counted[0]) > 0]
        bright = float(np.sqrt(np.mean(radiance**2)))
        scale = max(noise * (bright or 1.0), np.finfo(float).tiny) ** -2
        information = np.asarray(information, float) * scale
        added = _marginal(information, medium.channels, len(recovery.information))
        predictions.append(Prediction(candidate, recovery.covariance(added)))
    return sorted(predictions, key=lambda prediction: prediction.worst.deviation)


def _marginal(information: np.ndarray, channels: int, size: int) -> np.ndarray:
    """Eliminate the factors of a picture from its information about coefficients and unresolved
    widths, and add zeros for the factors of other pictures.
    """
    kept = np.r_[: 2 * channels, -channels:0]  # without the factors between them
    factors = np.arange(2 * channels, len(information) - channels)
    mixed = information[np.ix_(kept, factors)]
    pseudo_inverse = np.linalg.pinv(information[np.ix_(factors, factors)])
    marginal, corner = np.zeros((size, size)), np.ix_(kept, kept)
    marginal[corner] = information[corner] - mixed @ pseudo_inverse @ mixed.T
    return marginal
