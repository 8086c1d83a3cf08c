"""The result of a fit, from which another fit may start, and error bars from fits of perturbed
pictures.
"""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from splatjax.render import Plan
from splatjax.scene import AbstractLight, Camera, Material, Splats

from ._observation import Evidence, Observation
from ._parts import Coordinates


class FitState(eqx.Module):
    """The state of a fit after its last step.

    **Attributes:**

    - `x`: the coordinates for the next step.
    - `optimizer`: state of the optimizer; `None` for the initial state.
    - `plans`: plans of the pictures.
    - `expected`: means of the residuals of the priors; zero except in `randomized_fits`.
    """

    x: Coordinates
    optimizer: PyTree
    plans: list[Plan]
    expected: list[Array]


class FittedScene(eqx.Module):
    r"""The best scene of a fit.

    **Attributes:**

    - `splats`: the body.
    - `cameras`, `lights`: cameras and lights of each picture; `material`: the given material.
    - `maps`: the values of each parameter of a `ParameterMap`, by name.
    - `losses`: loss at the start and after each step: the sum over all pixels and priors, divided
      by the number of values that count. It is about 1 if the residuals are noise.
    - `best`: the step with the least loss, which the other fields describe. Static.
    - `plans`: number of plans, including the first. Static.
    - `pictures`: the rendered pictures; NaN where a pixel does not count.
    - `residuals`: rendered minus observed pictures.
    - `result`: the outcome, as a message (`optimistix.RESULTS`).
    - `coordinates`, `state`: coordinates and state for another fit to `start` from.
    """

    splats: Splats
    cameras: tuple[Camera, ...]
    lights: tuple[tuple[AbstractLight, ...], ...]
    material: Material
    maps: dict[str, Float[Array, " splats"]]
    losses: Float[np.ndarray, " steps"]
    pictures: tuple[Float[np.ndarray, "_ _ channels"], ...]
    residuals: tuple[Float[np.ndarray, "_ _ channels"], ...]
    result: optx.RESULTS
    coordinates: Coordinates
    state: FitState
    best: int = eqx.field(static=True)
    plans: int = eqx.field(static=True)

    def restarted(self, expected: list[Array] | None = None) -> "FittedScene":
        """Return the start of a new fit from the best step, with any optimizer. `expected` replaces
        the means of the residuals of the priors.
        """
        expected = self.state.expected if expected is None else expected
        state = FitState(self.coordinates, None, self.state.plans, expected)
        return eqx.tree_at(lambda f: (f.state, f.losses), self, (state, np.zeros(0)))


def randomized_fits(
    fit: Callable[..., FittedScene],
    observations: Sequence[Observation],
    fitted: FittedScene,
    count: int,
    *,
    seed: int = 0,
) -> list[FittedScene]:
    r"""Repeat a fit with perturbed pictures and priors. The spread of the results is the error bar.

        fit = partial(
            sj.inverse.fit_scene, splats=splats, material=material, parts=parts,
            optimizer=optimizer, steps=40,
        )
        fitted = fit(observations)
        draws = sj.inverse.randomized_fits(fit, observations, fitted, 16)
        bars = np.std([draw.maps["melanin"] for draw in draws], axis=0, ddof=1)

    Each fit starts from the best step of the given fit. Noise with the deviation of each picture is
    added to the picture, and the mean of each prior is drawn at random too. For a linear picture
    and converged fits, the results are draws from the posterior. Their spread includes noise and
    priors, but neither errors of the model nor distant solutions. A splat that no picture shows has
    the spread of the prior. Nothing is recompiled.

    **Arguments:**

    - `fit`: a function of observations and `start=` that calls `fit_scene`.
    - `observations`: the observations of the fit.
    - `fitted`: the converged fit.
    - `count`: number of draws. The relative error of an error bar is `1 / sqrt(2 (count - 1))`.
    - `seed`: seed of the noise.

    **Returns:** the fits.

    **Source:** Bardsley, Solonen, Haario and Laine 2014, "Randomize-then-optimize", without the
    projection that makes the draws exact for nonlinear pictures.
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
