"""Which picture to take next: by what it would do to the error bars."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatjax._format import percent
from splatjax._records import record, several
from splatjax.fitting import AbstractWeights
from splatjax.gaussians import AbstractProfile
from splatjax.render import RenderSettings
from splatjax.scattering import Dipole, Medium
from splatjax.scene import AbstractLight, Camera, DirectionalLight, GaussianBeam, Splats

from ._estimate import Combination, best_and_worst
from ._evidence import Evidence
from ._flat import Gatherer
from ._intensity import AbstractIntensity, KnownIntensity
from ._losses import SquaredLoss
from ._observation import Observation
from ._problem import Fitted, default_weights, solution
from ._recovery import Recovery


@record
class Candidate(eqx.Module):
    """A picture that could be taken: what it is called, from where, and under which lights. Its
    strength may be unknown.
    """

    name: str = eqx.field(static=True)
    camera: Camera
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    intensity: AbstractIntensity = KnownIntensity()


class Prediction(eqx.Module):
    r"""What a picture would do to the error bars.

    **Attributes:**

    - `candidate`: the picture.
    - `covariance`: of the logarithms of `sigma_a` and `sigma_s_prime` of each channel, with it.
    """

    candidate: Candidate
    covariance: Float[np.ndarray, "channels 2 2"]

    @property
    def worst(self) -> Combination:
        """The combination, of all channels, that is known worst then."""
        return max(
            (best_and_worst(each)[1] for each in self.covariance), key=lambda each: each.deviation
        )

    def __str__(self) -> str:
        return (
            f"{self.candidate.name}: the worst known, {self.worst},"
            f" then to {percent(self.worst.deviation)}"
        )


def next_pictures(
    recovery: Recovery,
    splats: Splats,
    candidates: Sequence[Candidate],
    *,
    model: Callable[[Medium], AbstractProfile] = Dipole,
    weights: AbstractWeights = default_weights(),
    settings: RenderSettings = RenderSettings(),
) -> list[Prediction]:
    r"""Rank pictures that could be taken by how well the coefficients would be known with each of
    them.

    Each is rendered once, of the material that was found, and differentiated; noise is taken to be
    the same share of its brightness as in the pictures before. Information adds up, and its inverse
    is the covariance.

    **Arguments:** `model` and `weights` as in `recover`.

    - `recovery`: what is known by now.
    - `splats`: of the body.
    - `candidates`: at least one; `default_candidates` gives some.
    - `settings`: of the renderer. By default those of `render`: a prediction needs no layers as
      fine as a search does.

    **Returns:** predictions; first the one whose worst known combination is known best.

    **Raises:** `ValueError` for no candidate, and for one that shows nothing of the body.
    """
    candidates = list(candidates)
    if not candidates:
        raise ValueError(
            "candidates is empty: name a picture that could be taken, or take "
            "default_candidates(splats, camera)"
        )
    medium, dtype = recovery.medium, recovery.medium.sigma_a.dtype
    cameras, lights = [each.camera for each in candidates], [each.lights for each in candidates]
    gathered, _ = Gatherer(splats, settings, cameras, lights).moving(recovery.material)
    variances = Fitted(recovery.material.gaussians.variances.astype(dtype))
    noise = recovery.relative_noise * recovery.scale**0.5
    before, found = len(recovery.information), []
    for candidate, picture in zip(candidates, gathered, strict=True):
        dark = np.zeros((candidate.camera.height, candidate.camera.width, len(medium.eta)))
        evidence = Evidence(
            [Observation(dark, candidate.camera, candidate.lights, intensity=candidate.intensity)],
            dtype,
        )
        unknowns, factors = evidence.unknowns(medium.eta)
        problem, _ = evidence.problem([picture], unknowns, variances, SquaredLoss(), weights, model)
        point = unknowns.start(medium, factors)
        seen = solution(problem, point)
        bright = float(jnp.sqrt(jnp.mean(seen.radiance**2)))
        deviations = noise * (bright or 1.0) / float(problem.deviation[0, 0])
        told = np.asarray(seen.information, float) / max(deviations, np.finfo(float).tiny) ** 2
        channels = len(medium.eta)
        found.append(
            Prediction(
                candidate, recovery.covariance(_marginal(told, 2 * channels, channels, before))
            )
        )
    return sorted(found, key=lambda each: each.worst.deviation)


def _marginal(information: np.ndarray, own: int, channels: int, size: int) -> np.ndarray:
    """Give what is told of coefficients and handover, whatever the picture's own factors are; with
    room for those of others.
    """
    kept = np.r_[:own, len(information) - channels : len(information)]
    factors = np.arange(own, len(information) - channels)
    told = information[np.ix_(kept, kept)]
    if factors.size:
        mixed = information[np.ix_(kept, factors)]
        told = told - mixed @ np.linalg.pinv(information[np.ix_(factors, factors)]) @ mixed.T
    there = np.r_[:own, size - channels : size]
    whole = np.zeros((size, size))
    whole[np.ix_(there, there)] = told
    return whole


def default_candidates(splats: Splats, camera: Camera, channels: int = 3) -> list[Candidate]:
    r"""Give pictures that one could take with a camera: parallel light from the front, left, right,
    above and behind, and a laser dot in the middle of the picture, as wide as a few splats.

    **Arguments:**

    - `splats`: of the body, mm.
    - `camera`: where it stands.
    - `channels`: of the pictures.
    """
    right, down, forward = np.asarray(camera.rotation, float)
    ways = {
        "light from the front": forward,
        "light from the left": right + 0.3 * forward,
        "light from the right": -right + 0.3 * forward,
        "light from above": down + 0.3 * forward,
        "light from behind": -forward + 0.5 * down,
    }
    dtype = splats.centers.dtype
    strength = jnp.full(channels, jnp.pi, dtype)
    lights = {
        name: DirectionalLight(direction=jnp.asarray(way, dtype), irradiance=strength)
        for name, way in ways.items()
    }
    found = [Candidate(name, camera, (light,)) for name, light in lights.items()]
    spot, spacing = _middle(splats, camera), float(np.sqrt(np.mean(splats.areas)))
    eye = np.asarray(camera.position, float)
    beam = GaussianBeam(
        jnp.asarray(eye, dtype),
        jnp.asarray(spot - eye, dtype),
        strength * spacing**2,
        jnp.asarray((2 * spacing) ** 2, dtype),
    )
    return [*found, Candidate("a laser dot in the middle", camera, (beam,))]


def _middle(splats: Splats, camera: Camera) -> np.ndarray:
    """Give the center of the nearest splat at the middle of the picture, or of the one that is next
    to it.
    """
    offset = np.asarray(splats.centers, float) - np.asarray(camera.position, float)
    across, down, depth = np.asarray(camera.rotation, float) @ offset.T
    aside = np.hypot(across, down) / np.maximum(depth, 1e-9) + np.where(depth > 0, 0.0, np.inf)
    near = aside <= 1.5 * np.min(aside) + 2 * float(np.mean(splats.radii)) / float(np.mean(depth))
    return np.asarray(splats.centers, float)[np.argmin(np.where(near, depth, np.inf))]
