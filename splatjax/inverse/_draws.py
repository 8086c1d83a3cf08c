"""Error bars of a fit: fits of perturbed pictures."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from ._fit_scene import FittedScene
from ._observation import Evidence, Observation


def randomized_fits(
    fit: Callable[..., FittedScene],
    observations: Sequence[Observation],
    fitted: FittedScene,
    count: int,
    *,
    seed: int = 0,
) -> list[FittedScene]:
    r"""Repeat a fit with perturbed pictures and priors: the spread of the results is the error bar.

        fit = partial(
            sj.inverse.fit_scene, splats=splats, material=material, parts=parts,
            optimizer=optimizer, steps=40,
        )
        fitted = fit(observations)
        draws = sj.inverse.randomized_fits(fit, observations, fitted, 16)
        bars = np.std([draw.maps["melanin"] for draw in draws], axis=0, ddof=1)

    Each fit starts from the best step of the given fit. Noise with the deviation of each picture is
    added to it, and the mean of each prior is drawn at random, too. For a linear picture and
    converged fits, the results are then draws from the posterior. Their spread describes noise and
    priors, but neither errors of the model nor other solutions far away. A splat that no picture
    shows has the spread of the prior. Nothing is compiled again.

    **Arguments:**

    - `fit`: function of observations and `start=` that calls `fit_scene`.
    - `observations`: the observations of the fit.
    - `fitted`: the converged fit.
    - `count`: number of draws. The relative error of a bar is `1 / sqrt(2 (count - 1))`.
    - `seed`: seed of the noise.

    **Returns:** the fits.

    **Source:** Bardsley, Solonen, Haario and Laine 2014, "Randomize-then-optimize", without the
    projection that makes it exact for pictures that are not linear.
    """
    rng, draws = np.random.default_rng(seed), []

    def noise(values):
        return rng.normal(size=values.shape)

    for _ in range(count):
        perturbed = []
        for observation in observations:
            deviation = np.asarray(Evidence.of(observation, observation.picture.dtype).deviation)
            picture = np.asarray(observation.picture) + deviation * noise(deviation)
            perturbed.append(dataclasses.replace(observation, picture=picture, deviation=deviation))
        expected = [jnp.asarray(noise(leaf), leaf.dtype) for leaf in fitted.state.expected]
        draws.append(fit(perturbed, start=fitted.restarted(expected)))
    return draws
