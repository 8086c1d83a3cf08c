"""Pictures to take next, ranked by the error bars with them."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from splatjax._format import percent
from splatjax._records import record, several
from splatjax.render import RenderSettings
from splatjax.scene import AbstractLight, Camera, DirectionalLight, GaussianBeam, Splats

from ._observation import AbstractIntensity, Evidence, KnownIntensity, Observation, SquaredLoss
from ._parts import PicturedScene
from ._problem import RecoveryProblem, Unknowns, fit_near, render_layers, solution
from ._recovery import Combination, Recovery, best_and_worst


@record
class Candidate(eqx.Module):
    """A picture that could be taken: its name, camera and lights, whose strength may be unknown."""

    name: str = eqx.field(static=True)
    camera: Camera
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    intensity: AbstractIntensity = KnownIntensity()


class Prediction(eqx.Module):
    r"""The error bars with another picture.

    **Attributes:**

    - `candidate`: the picture.
    - `covariance`: of the logarithms of `sigma_a` and `sigma_s_prime` of each channel, with it.
    """

    candidate: Candidate
    covariance: Float[np.ndarray, "channels 2 2"]

    @property
    def worst(self) -> Combination:
        """The combination with the largest error, of all channels."""
        worst = [best_and_worst(covariance)[1] for covariance in self.covariance]
        return max(worst, key=lambda combination: combination.deviation)

    def __str__(self) -> str:
        return (
            f"{self.candidate.name}: the least known combination, {self.worst}, would be known "
            f"to {percent(self.worst.deviation)}"
        )


def next_pictures(
    recovery: Recovery,
    splats: Splats,
    candidates: Sequence[Candidate],
    *,
    settings: RenderSettings = RenderSettings(),
) -> list[Prediction]:
    r"""Rank pictures that could be taken, by the error bars of the coefficients with each of them.

    Each is rendered once with the recovered material, and differentiated. Its noise is the same
    fraction of its brightness as in the earlier pictures. Information adds up, and its inverse is
    the covariance.

    **Arguments:**

    - `recovery`: from the earlier pictures, with its model and weights.
    - `splats`: of the body.
    - `candidates`: at least one; see `default_candidates`.
    - `settings`: of the renderer. By default those of `render`: a prediction needs less fine layers
      than a search.

    **Returns:** predictions; first the one with the least error of its worst combination.

    **Raises:** `ValueError` for no candidate, and for one in which the body is not visible.
    """
    candidates = list(candidates)
    if not candidates:
        raise ValueError(
            "candidates is empty; give a picture that could be taken, or "
            "default_candidates(splats, camera)"
        )
    medium, loss = recovery.medium, SquaredLoss()
    dtype = medium.eta.dtype
    pictured_scenes = [PicturedScene(splats, one.camera, one.lights) for one in candidates]
    pictures, _ = render_layers(pictured_scenes, recovery.material, settings)
    near = recovery.material.gaussians.variances.astype(dtype)
    fit = eqx.Partial(fit_near, near=near, weights=recovery.weights, rule=recovery.model.rule)
    noise = recovery.relative_noise * recovery.scale**0.5
    predictions = []
    for candidate, picture in zip(candidates, pictures, strict=True):
        dark = np.zeros(picture.specular.shape)
        observation = Observation(dark, candidate.camera, candidate.lights, deviation=1)
        evidence = Evidence.of(observation, dtype)
        unknowns = Unknowns.of(medium.eta, [candidate.intensity])
        problem = RecoveryProblem.of([picture], [evidence], unknowns, fit, loss, recovery.model)
        at_point = solution(problem, unknowns.start(medium))
        radiance = np.asarray(at_point.radiance[0])[np.asarray(problem.counted[0]) > 0]
        bright = float(np.sqrt(np.mean(radiance**2)))
        scale = max(noise * (bright or 1.0), np.finfo(float).tiny) ** -2
        information = np.asarray(at_point.information, float) * scale
        more = _marginal(information, medium.channels, len(recovery.information))
        predictions.append(Prediction(candidate, recovery.covariance(more)))
    return sorted(predictions, key=lambda prediction: prediction.worst.deviation)


def _marginal(information: np.ndarray, channels: int, size: int) -> np.ndarray:
    """Eliminate the factors of a picture from its information about coefficients and the transition
    to unresolved layers, and add zeros for the factors of other pictures.
    """
    kept = np.r_[: 2 * channels, -channels:0]  # whatever the number of factors between them
    factors = np.arange(2 * channels, len(information) - channels)
    mixed = information[np.ix_(kept, factors)]
    pseudo_inverse = np.linalg.pinv(information[np.ix_(factors, factors)])
    marginal, corner = np.zeros((size, size)), np.ix_(kept, kept)
    marginal[corner] = information[corner] - mixed @ pseudo_inverse @ mixed.T
    return marginal


def default_candidates(splats: Splats, camera: Camera, channels: int = 3) -> list[Candidate]:
    r"""Propose pictures that one could take with a camera: parallel light from the front, left,
    right, above and behind, and a laser dot in the middle of the picture, as wide as a few splats.

    **Arguments:**

    - `splats`: of the body, mm.
    - `camera`: of all pictures.
    - `channels`: of the pictures.
    """
    right, down, forward = np.asarray(camera.rotation, float)
    directions = {
        "light from the front": forward,
        "light from the left": right + 0.3 * forward,
        "light from the right": -right + 0.3 * forward,
        "light from above": down + 0.3 * forward,
        "light from behind": -forward + 0.5 * down,
    }
    strength, eye = np.full(channels, np.pi), np.asarray(camera.position, float)
    squared_spacing = float(np.mean(splats.areas))
    # The center of the nearest splat at the middle of the picture, or beside it.
    centers = np.asarray(splats.centers, float)
    across, below, depth = np.stack([right, down, forward]) @ (centers - eye).T
    aside = np.hypot(across, below) / np.maximum(depth, 1e-9) + np.where(depth > 0, 0.0, np.inf)
    reach = 1.5 * np.min(aside) + 2 * float(np.mean(splats.radii)) / float(np.mean(depth))
    spot = centers[np.argmin(np.where(aside <= reach, depth, np.inf))]
    beam = GaussianBeam(eye, spot - eye, strength * squared_spacing, 4 * squared_spacing)
    lights = {
        name: DirectionalLight(direction=direction, irradiance=strength)
        for name, direction in directions.items()
    } | {"a laser dot in the middle": beam}
    return [Candidate(name, camera, light) for name, light in lights.items()]
