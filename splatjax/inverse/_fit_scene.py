"""Fit a scene to pictures along the gradient of the renderer: albedo, shape, lights and cameras."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import DTypeLike, Float, PyTree

from splatjax._records import as_floats
from splatjax.render import Plan, RenderSettings
from splatjax.scene import AbstractLight, Camera, Material, Scene, Splats

from ._descent import (
    Coordinates,
    Evaluation,
    GradientTransformation,
    MovableScene,
    advance,
    evaluate,
    standard_promotion,
)
from ._layers import make_plans
from ._losses import (
    AbstractBackground,
    AbstractLoss,
    SquaredLoss,
    UnknownBackground,
)
from ._observation import (
    Evidence,
    KnownIntensity,
    Observation,
    check_channels,
    nothing_counts,
)
from ._parts import AbstractPart, Setup

Tree = TypeVar("Tree", bound=PyTree)


class FittedScene(eqx.Module):
    r"""The best that a fit came by.

    **Attributes:**

    - `splats`: the body.
    - `cameras`, `lights`: of each picture.
    - `material`: as it was given.
    - `losses`: at the start and after each step: sum of the losses of all pixels and of what the
      priors add, over the number of values that count. About 1 where what is left is noise.
    - `best`: the step with the least of them, which all else here is of. Static.
    - `plans`: how many times was planned, once for the start. Static.
    - `pictures`: what the renderer makes of it; NaN where a pixel does not count.
    - `residuals`: pictures less what was observed.
    - `result`: what became of it, as a message (`optimistix.RESULTS`).
    """

    splats: Splats
    cameras: tuple[Camera, ...]
    lights: tuple[tuple[AbstractLight, ...], ...]
    material: Material
    losses: Float[np.ndarray, " steps"]
    pictures: tuple[Float[np.ndarray, "_ _ channels"], ...]
    residuals: tuple[Float[np.ndarray, "_ _ channels"], ...]
    result: optx.RESULTS
    best: int = eqx.field(static=True)
    plans: int = eqx.field(static=True)

    def scene(self, picture: int = 0) -> Scene:
        """Return the scene of a picture."""
        return Scene(self.splats, self.lights[picture], self.material)


def fit_scene(
    observations: Sequence[Observation],
    splats: Splats,
    material: Material,
    parts: Sequence[AbstractPart],
    optimizer: GradientTransformation,
    *,
    steps: int,
    loss: AbstractLoss = SquaredLoss(),
    background: AbstractBackground = UnknownBackground(),
    settings: RenderSettings = RenderSettings(),
    progress: Callable[[str, float], None] | None = None,
    throw: bool = True,
) -> FittedScene:
    r"""Move parts of a scene along the gradient of its pictures until they match the observed
    pictures.

    Each part has unbounded coordinates that count its steps; the optimizer sees nothing else, so
    that one learning rate serves all. The fit minimizes

        sum_pixels loss((rendered - observed) / deviation) + sum_coordinates (moved / expected)^2

    over the number of values of pixels, the second sum over parts with a prior. Nothing is compiled
    between steps. Where the scene outgrows its plan, a new plan is made.

    **Arguments:**

    - `observations`: one or more; `CameraPoses`, `LightStrengths` and `LightPlaces` start from
      their cameras and lights, which are right if these do not move. A deviation of the noise that
      is not given is 1% of the root mean square of the picture.
    - `splats`: the body, mm; `AlbedoMap` and `NormalOffsets` start from it.
    - `material`: known. `recover` finds coefficients.
    - `parts`: what may move, each kind once.
    - `optimizer`: any of optax whose update needs gradients alone. Its rate is in steps:
      `optax.adam(1.0)` first moves each coordinate by one step at a time. With a rate that falls to
      zero, such as `optax.cosine_decay_schedule(1.0, steps)`, the fit comes to rest.
    - `steps`: how many.
    - `loss`: `SquaredLoss()`, or `HuberLoss()` where the model does not explain some pixels.
    - `background`: `UnknownBackground()`: only pixels that the body fills count.
      `BlackBackground()`: all pixels that masks leave count, which determines cameras and outlines
      much better.
    - `settings`: of the renderer.
    - `progress`: called with a description of each stage, and the loss.
    - `throw`: raise when a loss or gradient is not finite; otherwise `result` reports it, and the
      best scene so far is returned.

    **Returns:** a `FittedScene`: the best of all steps, in the precision of the splats.

    **Raises:** `ValueError` for no observation, part or step, for parts given twice or with nothing
    to move, for channels that disagree, for lights of unknown intensity (say `LightStrengths`
    instead), and for a picture none of whose pixels counts; an error with the message of `result`
    if `throw`.
    """
    observations, parts = list(observations), list(parts)
    _check(observations, material, parts, steps)
    report = progress or (lambda stage, loss: None)
    dtype = splats.centers.dtype
    setups = [_cast(Setup(splats, one.camera, one.lights), dtype) for one in observations]
    scene = MovableScene.of(setups[0].splats, _cast(material, dtype), parts)
    evidence = [Evidence.of(one, dtype) for one in observations]
    x = scene.start(setups)

    def moved(x: Coordinates) -> list[Setup]:
        return [scene.moved(setup, scene.of_picture(x, i)) for i, setup in enumerate(setups)]

    def plan_all(x: Coordinates) -> list[Plan]:
        scenes = [Scene(one.splats, one.lights, scene.material) for one in moved(x)]
        return make_plans(scenes, [one.camera for one in moved(x)], settings)

    def evaluate_all(x: Coordinates, plans: list[Plan]) -> list[Evaluation]:
        return [
            evaluate(scene.of_picture(x, i), scene, *one, settings, loss, background)
            for i, one in enumerate(zip(setups, evidence, plans, strict=True))
        ]

    report("planning", math.nan)
    plans, times = plan_all(x), 1
    with standard_promotion():
        state = optimizer.init(x)
    best, at, losses, result = None, x, [], optx.RESULTS.successful
    for step in range(steps + 1):
        evaluations = evaluate_all(x, plans)
        if max(float(one.overflow) for one in evaluations) > 0:
            last = losses[-1] if losses else math.nan
            report(f"step {step}: the scene exceeds the capacity of its plan; planning again", last)
            plans, times = plan_all(x), times + 1
            evaluations = evaluate_all(x, plans)
        for i, evaluation in enumerate(evaluations if step == 0 else ()):
            if not np.any(np.asarray(evaluation.counted) > 0):
                raise nothing_counts(i)
        values = [(one.loss, one.count, one.gradient) for one in evaluations]
        ahead, state, value, finite = advance(x, state, values, scene, optimizer)
        losses.append(float(value))
        if not bool(finite):
            result = optx.RESULTS.nonfinite
            break
        if best is None or losses[-1] < losses[best]:
            best, at, kept = step, x, evaluations
        report(f"step {step} of {steps}", losses[-1])
        x = ahead
    if best is None:
        raise ValueError(
            "loss or gradient of the start is not finite: look for NaN in splats, lights and "
            "cameras, and for splats at a light"
        )
    pictures = tuple(
        np.where(np.asarray(one.counted)[..., None] > 0, np.asarray(one.beauty), np.nan)
        for one in kept
    )
    fitted = FittedScene(
        splats=moved(at)[0].splats,
        cameras=tuple(one.camera for one in moved(at)),
        lights=tuple(one.lights for one in moved(at)),
        material=scene.material,
        losses=np.asarray(losses),
        pictures=pictures,
        residuals=tuple(
            made - np.asarray(one.picture) for made, one in zip(pictures, evidence, strict=True)
        ),
        result=result,
        best=best,
        plans=times,
    )
    if throw and result != optx.RESULTS.successful:
        return fitted.result.error_if(fitted, True)
    return fitted


def _cast(tree: Tree, dtype: DTypeLike) -> Tree:
    return jax.tree.map(lambda leaf: as_floats(np.asarray(leaf), dtype), tree)


def _check(
    observations: list[Observation],
    material: Material,
    parts: list[AbstractPart],
    steps: int,
) -> None:
    if not observations or not parts or steps < 1:
        raise ValueError(
            f"one observation, one part and one step are needed at least; got {len(observations)}, "
            f"{len(parts)} and {steps}"
        )
    kinds = [type(part).__name__ for part in parts]
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"each kind of part may be given once; parts are {', '.join(kinds)}")
    channels = material.channels
    for i, observation in enumerate(observations):
        check_channels(i, observation, channels, "material")
        if not isinstance(observation.intensity, KnownIntensity):
            raise ValueError(
                f"observations[{i}].intensity is {type(observation.intensity).__name__}(): that is "
                "for recover; here LightStrengths among the parts lets lights be of any strength"
            )
