"""Fits of a scene to pictures by gradients of the renderer: albedo, shape, lights and cameras."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from splatjax._chunking import jit_unless_traced
from splatjax._records import as_floats, require
from splatjax.render import Plan, RenderSettings, render
from splatjax.scene import Material, Splats

from ._fitted_scene import FitState, FittedScene
from ._observation import (
    AbstractBackground,
    AbstractLoss,
    Evidence,
    KnownIntensity,
    Observation,
    PicturedScene,
    SquaredLoss,
    UnknownBackground,
    check_channels,
    check_counted,
    compared,
)
from ._parts import AbstractPart, Coordinates, MovableScene
from ._problem import make_plans


class Evaluation(eqx.Module):
    """A rendered picture, its total loss, and the gradient of the loss with respect to the
    coordinates of the picture.
    """

    loss: Float[Array, ""]
    gradient: Coordinates
    overflow: Float[Array, ""]
    beauty: Float[Array, "height width channels"]
    counted: Float[Array, "height width"]


@jit_unless_traced
def evaluate(
    x: Coordinates,
    scene: MovableScene,
    pictured: PicturedScene,
    evidence: Evidence,
    plan: Plan,
    settings: RenderSettings,
    loss: AbstractLoss,
    background: AbstractBackground,
) -> Evaluation:
    """Render a picture at given coordinates, and differentiate its loss."""

    def total_loss(x):
        moved = scene.moved(pictured, x)
        frame = render(moved.scene(scene.material), moved.camera, settings, plan)
        counted = evidence.counted(frame.coverage, background)
        return jnp.sum(evidence.residuals(frame.beauty, counted, loss) ** 2), (counted, frame)

    (value, (counted, frame)), gradient = jax.value_and_grad(total_loss, has_aux=True)(x)
    return Evaluation(value, gradient, frame.overflow, frame.beauty, counted)


@jit_unless_traced
def advance(
    x: Coordinates,
    state: PyTree,
    evaluations: Sequence[Evaluation],
    scene: MovableScene,
    expected: list[Array],
    optimizer: Any,
):
    """Take a step, and return the loss before the step and whether loss and gradient are finite."""

    def prior_loss(x):
        residuals = jax.tree.map(jnp.subtract, scene.prior_residuals(x), expected)
        return jnp.asarray(sum((jnp.sum(leaf**2) for leaf in residuals), 0.0))

    prior, prior_gradient = jax.value_and_grad(prior_loss)(x)
    counts = [
        jnp.sum(evaluation.counted) * evaluation.beauty.shape[2] for evaluation in evaluations
    ]
    count = jnp.maximum(sum(counts), 1.0)
    gradient = jax.tree.map(
        lambda *leaves: sum(leaves) / count,
        scene.of_all([evaluation.gradient for evaluation in evaluations]),
        prior_gradient,
    )
    loss = (sum(evaluation.loss for evaluation in evaluations) + prior) / count
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, gradient))])
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        updates, state = optimizer.update(gradient, state, x)
    return jax.tree.map(jnp.add, x, updates), state, loss, jnp.all(finite)


def fit_scene(
    observations: Sequence[Observation],
    splats: Splats,
    material: Material,
    parts: Sequence[AbstractPart],
    optimizer: Any,
    *,
    steps: int,
    loss: AbstractLoss = SquaredLoss(),
    background: AbstractBackground = UnknownBackground(),
    settings: RenderSettings = RenderSettings(),
    start: FittedScene | None = None,
    progress: Callable[[str, float], None] | None = None,
    throw: bool = True,
) -> FittedScene:
    r"""Fit parts of a scene to observed pictures by gradients of the rendered pictures.

        seen = Observation(picture, camera, lights, deviation=noise)
        optimizer = optax.adam(optax.cosine_decay_schedule(2.0, 60), b2=0.9)
        fitted = fit_scene([seen], splats, material, [AlbedoMap()], optimizer, steps=60)
        fitted.splats.albedo, fitted.losses

    Each part has unbounded coordinates in units of its step, so that one learning rate serves all
    parts. The fit minimizes

        sum_pixels loss((rendered - observed) / noise) + sum_coordinates (change / deviation)^2

    divided by the number of pixel values that count. The `noise` is `Observation.deviation`. The
    second sum is the prior of the parts that have a `deviation`. Nothing is recompiled between
    steps, unless the scene exceeds the capacity of its plan and a new plan is made.

    **Arguments:**

    - `observations`: one or more. `CameraPoses`, `LightStrengths` and `LightPlaces` start from
      their cameras and lights; other cameras and lights are assumed exact. Without a deviation, the
      noise is 1% of the root mean square of the picture.
    - `splats`: the body, mm; `AlbedoMap` and `NormalOffsets` start from it.
    - `material`: the known material. With a `ParameterMap`, it must have the Gaussians of the
      table. To fit coefficients, use `recover`.
    - `parts`: the parts that may change, each kind at most once.
    - `optimizer`: any optax optimizer whose update needs only gradients. Its learning rate is in
      units of the step: `optax.adam(1.0)` initially moves each coordinate by one step. For
      convergence, use a rate that decays to 0, such as `optax.cosine_decay_schedule(1.0, steps)`.
    - `steps`: number of steps.
    - `loss`: `SquaredLoss()`, or `HuberLoss()` if the model does not explain some pixels.
    - `background`: with `UnknownBackground()`, only pixels that the body fills count. With
      `BlackBackground()`, all unmasked pixels count, which determines cameras and outlines much
      better.
    - `settings`: settings of the renderer.
    - `start`: a fit to continue for another `steps` steps. If all other arguments are equal, the
      result is bit for bit that of one fit with all steps.
    - `progress`: called with a description of each stage, and the loss.
    - `throw`: raise if a loss or gradient is not finite; otherwise `result` reports it, and the
      best scene so far is returned.

    **Returns:** a `FittedScene` of the best step, in the precision of the splats.

    **Raises:** `ValueError` without observations, parts or steps, for a part given twice or without
    anything to change, for unequal numbers of channels, for lights of unknown intensity (use
    `LightStrengths`), and for a picture without a pixel that counts; an error with the message of
    `result` if `throw`.
    """
    observations, parts = list(observations), list(parts)
    _check(observations, material, parts, steps)
    report = progress or (lambda stage, loss: None)
    dtype = splats.centers.dtype
    pictured_scenes, material = jax.tree.map(
        lambda leaf: as_floats(np.asarray(leaf), dtype),
        ([PicturedScene(splats, view.camera, view.lights) for view in observations], material),
    )
    scene = MovableScene.of(pictured_scenes[0].splats, material, parts)
    evidence = [Evidence.of(observation, dtype) for observation in observations]

    def moved(x: Coordinates) -> list[PicturedScene]:
        return [
            scene.moved(pictured, scene.of_picture(x, i))
            for i, pictured in enumerate(pictured_scenes)
        ]

    def evaluate_all(x: Coordinates, plans: list[Plan]) -> list[Evaluation]:
        return [
            evaluate(scene.of_picture(x, i), scene, *inputs, settings, loss, background)
            for i, inputs in enumerate(zip(pictured_scenes, evidence, plans, strict=True))
        ]

    if start is None:
        x = scene.start(pictured_scenes)
        report("planning", np.nan)
        plans, times = make_plans(moved(x), material, settings), 1
        expected, state = jax.tree.map(jnp.zeros_like, scene.prior_residuals(x)), None
        best, at, losses, pictures, residuals = None, x, [], (), ()
    else:
        x, state = start.state.x, start.state.optimizer
        ours, given = (jax.tree.map(jnp.shape, y) for y in (scene.start(pictured_scenes), x))
        require(
            ours == given and len(start.state.plans) == len(observations),
            f"start is a fit of {len(start.state.plans)} pictures with coordinates {given}; "
            f"{len(observations)} pictures with {ours} are given; continue with the same parts, "
            "splats and number of pictures",
        )
        plans, times, expected = start.state.plans, start.plans, start.state.expected
        at, losses = start.coordinates, start.losses.tolist()
        pictures, residuals = jax.tree.map(np.asarray, (start.pictures, start.residuals))
        best = start.best if losses else None
    if state is None:
        # Optimizers need JAX's default rules of promotion.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            state = optimizer.init(x)
    kept, result = None, optx.RESULTS.successful
    first = len(losses)
    last = max(first - 1, 0) + steps
    for step in range(first, last + 1):
        evaluations = evaluate_all(x, plans)
        if max(float(evaluation.overflow) for evaluation in evaluations) > 0:
            report(
                f"step {step}: the scene exceeds the capacity of its plan; planning again",
                losses[-1] if losses else np.nan,
            )
            plans, times = make_plans(moved(x), material, settings), times + 1
            evaluations = evaluate_all(x, plans)
        if step == 0:
            check_counted([evaluation.counted for evaluation in evaluations])
        ahead, state, value, finite = advance(x, state, evaluations, scene, expected, optimizer)
        losses.append(float(value))
        if not bool(finite):
            result = optx.RESULTS.nonfinite
            break
        if best is None or losses[-1] < losses[best]:
            best, at, kept = step, x, evaluations
        report(f"step {step} of {last}", losses[-1])
        x = ahead
    if best is None:
        raise ValueError(
            "loss or gradient of the start is not finite; check for NaN in splats, lights and "
            "cameras, and for splats at a light"
        )
    if kept is not None:
        pictures, residuals = compared(
            [evaluation.beauty for evaluation in kept],
            [evaluation.counted for evaluation in kept],
            evidence,
        )
    pictured_scenes = moved(at)
    fitted = FittedScene(
        splats=pictured_scenes[0].splats,
        cameras=tuple(pictured.camera for pictured in pictured_scenes),
        lights=tuple(pictured.lights for pictured in pictured_scenes),
        material=material,
        maps=scene.maps(at),
        losses=np.asarray(losses),
        pictures=pictures,
        residuals=residuals,
        result=result,
        coordinates=at,
        state=FitState(x, state, plans, expected),
        best=best,
        plans=times,
    )
    return result.error_if(fitted, result != optx.RESULTS.successful) if throw else fitted


def _check(
    observations: list[Observation], material: Material, parts: list[AbstractPart], steps: int
) -> None:
    require(
        observations and parts and steps > 0,
        "at least one observation, one part and one step are needed; got "
        f"{len(observations)}, {len(parts)} and {steps}",
    )
    for part in parts:
        part.check_material(material)
    kinds = [type(part).__name__ for part in parts]
    require(
        len(set(kinds)) == len(kinds),
        f"parts are {', '.join(kinds)}; give each kind of part at most once",
    )
    check_channels(observations, material.channels, "material")
    for i, observation in enumerate(observations):
        require(
            isinstance(observation.intensity, KnownIntensity),
            f"observations[{i}].intensity is {type(observation.intensity).__name__}(), which is "
            "for recover; for unknown strengths of lights, add LightStrengths to parts",
        )
