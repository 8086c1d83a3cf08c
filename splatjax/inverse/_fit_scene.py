"""From pictures to what a body looks like and how they were taken: first-order, along the gradient
of the renderer.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from splatjax.render import Plan, RenderSettings
from splatjax.scene import Material, Scene, Splats

from ._background import AbstractBackground, UnknownBackground
from ._descent import (
    Coordinates,
    GradientTransformation,
    Told,
    World,
    advance,
    pictures_of,
    tell,
    usual_promotion,
)
from ._evidence import Evidence
from ._fitted_scene import FittedScene
from ._intensity import KnownIntensity
from ._losses import AbstractLoss, SquaredLoss
from ._observation import Observation, nothing_counts
from ._parts import AbstractPart, Shot
from ._plans import plans_of


def fit_scene(
    observations: Sequence[Observation],
    splats: Splats,
    material: Material,
    parts: Sequence[AbstractPart],
    optimizer: GradientTransformation,
    *,
    steps: int,
    loss: AbstractLoss | None = None,
    background: AbstractBackground | None = None,
    settings: RenderSettings | None = None,
    progress: Callable[[str, float], None] | None = None,
    throw: bool = True,
) -> FittedScene:
    r"""Move parts of a scene along the gradient of its pictures until they look like those
    observed.

    Each part has coordinates of its own that know no bounds and count its steps; the optimizer sees
    nothing else, so that one learning rate serves all. What is made least is

        sum_pixels loss((rendered - observed) / deviation) + sum_coordinates (moved / expected)^2

    over the number of pixels' values, the second sum over parts with a prior. Nothing is compiled
    between steps. A plan that the scene has outgrown is made anew, from where the scene is then.

    **Arguments:**

    - `observations`: one or more; their cameras and lights are where `CameraPoses`,
      `LightStrengths` and `LightPlaces` start, and right if these do not move. A deviation of the
      noise that is not given is 1% of the picture's root mean square.
    - `splats`: the body, mm, where `AlbedoMap` and `NormalOffsets` start.
    - `material`: known. `recover` finds coefficients.
    - `parts`: what may move, each kind once.
    - `optimizer`: any of optax whose update needs gradients alone. Its rate is in steps:
      `optax.adam(1.0)` moves each coordinate by a step at a time at first. A rate that falls to
      nothing, such as `optax.cosine_decay_schedule(1.0, steps)`, lets it come to rest.
    - `steps`: how many.
    - `loss`: `SquaredLoss()`, or `HuberLoss()` where some pixels are not what the model knows.
    - `background`: `UnknownBackground()`: only pixels that the body fills count.
      `BlackBackground()`: all that masks leave do; cameras and outlines are then much better told.
    - `settings`: of the renderer.
    - `progress`: told in words what is being done, and the loss.
    - `throw`: raise when a loss or gradient is not finite; otherwise `result` says so, and what was
      best up to then is given.

    **Returns:** a `FittedScene`: the best of all steps, in the precision of the splats.

    **Raises:** `ValueError` for no observation, part or step, for parts given twice or with nothing
    to move, for channels that disagree, for lights of unknown intensity (say `LightStrengths`
    instead), and for a picture none of whose pixels counts; an error with the message of `result`
    if `throw`.
    """
    observations, parts = list(observations), list(parts)
    _check(observations, splats, material, parts, steps)
    settings = RenderSettings() if settings is None else settings
    loss = SquaredLoss() if loss is None else loss
    background = UnknownBackground() if background is None else background
    say = progress or _nobody
    dtype = splats.centers.dtype
    shots = [_cast(Shot(each.camera, each.lights), dtype) for each in observations]
    world = World.of(_cast(splats, dtype), _cast(material, dtype), parts)
    seen = pictures_of(Evidence(observations, dtype))
    x = Coordinates(world.coordinates(), tuple(world.shot_coordinates(shot) for shot in shots))

    def planned(x: Coordinates) -> list[Plan]:
        moved = [world.shot_at(shot, its) for shot, its in zip(shots, x.shots, strict=True)]
        body = world.splats_at(x.body)
        return plans_of(
            [Scene(body, each.lights, world.material) for each in moved],
            [each.camera for each in moved],
            settings,
        )

    def told(x: Coordinates, plans: list[Plan]) -> list[Told]:
        together = zip(x.shots, shots, seen, plans, strict=True)
        return [
            tell(x.body, its, world, shot, one, plan, settings, loss, background)
            for its, shot, one, plan in together
        ]

    say("planning", float("nan"))
    plans, times = planned(x), 1
    with usual_promotion():
        state = optimizer.init(x)
    best, at, losses, result = None, x, [], optx.RESULTS.successful
    for step in range(steps + 1):
        pictures = told(x, plans)
        if max(float(each.overflow) for each in pictures) > 0:
            say(
                f"step {step}: the scene has outgrown its plan; planning anew",
                losses[-1] if losses else float("nan"),
            )
            plans, times = planned(x), times + 1
            pictures = told(x, plans)
        if step == 0:
            _check_counted(pictures)
        ahead, state, value, finite = advance(
            x, state, [each.value for each in pictures], world, optimizer
        )
        losses.append(float(value))
        if not bool(finite):
            result = optx.RESULTS.nonfinite
            break
        if best is None or losses[-1] < losses[best]:
            best, at, kept = step, x, pictures
        say(f"step {step} of {steps}", losses[-1])
        x = ahead
    if best is None:
        raise ValueError(
            "loss or gradient of the start is not finite: look for NaN in splats, lights and "
            "cameras, and for splats at a light"
        )
    moved = [world.shot_at(shot, its) for shot, its in zip(shots, at.shots, strict=True)]
    shown = [
        _shown(each.beauty, each.counted, one.picture) for each, one in zip(kept, seen, strict=True)
    ]
    fitted = FittedScene(
        splats=world.splats_at(at.body),
        cameras=tuple(each.camera for each in moved),
        lights=tuple(each.lights for each in moved),
        material=world.material,
        losses=np.asarray(losses),
        pictures=tuple(made for made, _ in shown),
        residuals=tuple(left for _, left in shown),
        result=result,
        best=best,
        plans=times,
    )
    return (
        fitted.result.error_if(fitted, True)
        if throw and result != optx.RESULTS.successful
        else fitted
    )


def _shown(beauty, counted, picture) -> tuple[np.ndarray, np.ndarray]:
    """Give a picture and what it is off, NaN where it does not count."""
    made = np.where(np.asarray(counted)[..., None] > 0, np.asarray(beauty), np.nan)
    return made, made - np.asarray(picture)


def _cast(tree, dtype):
    return jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf), dtype) if eqx.is_inexact_array(leaf) else leaf,
        tree,
    )


def _check(
    observations: list[Observation],
    splats: Splats,
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
    channels = material.gaussians.weights.shape[1]
    for i, each in enumerate(observations):
        if each.picture.shape[2] != channels:
            raise ValueError(
                f"observations[{i}].picture has {each.picture.shape[2]} channels, material has "
                f"{channels}"
            )
        if not isinstance(each.intensity, KnownIntensity):
            raise ValueError(
                f"observations[{i}].intensity is {type(each.intensity).__name__}(): that is for "
                "recover; "
                "here LightStrengths among the parts lets lights be of any strength"
            )


def _check_counted(pictures: list[Told]) -> None:
    for i, each in enumerate(pictures):
        if not np.any(np.asarray(each.counted) > 0):
            raise nothing_counts(i)


def _nobody(said: str, loss: float) -> None:
    del said, loss
