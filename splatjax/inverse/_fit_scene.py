"""From pictures to what a body looks like and how they were taken: first-order, along the gradient of the renderer."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from splatjax.render import Plan, RenderSettings, render
from splatjax.scene import Material, Scene, Splats

from ._background import AbstractBackground, UnknownBackground
from ._evidence import Evidence
from ._fitted_scene import FittedScene
from ._intensity import KnownIntensity
from ._losses import AbstractLoss, SquaredLoss
from ._observation import Observation
from ._parts import AbstractBodyPart, AbstractPart, AbstractShotPart, Shot
from ._plans import plans_of


@runtime_checkable
class GradientTransformation(Protocol):
    """What optax calls so: a pair of functions."""

    init: Callable[..., Any]
    update: Callable[..., Any]


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
    r"""Move parts of a scene along the gradient of its pictures until they look like those observed.

    Each part has coordinates of its own that know no bounds and count its steps; the optimizer sees nothing else, so that one
    learning rate serves all. What is made least is

        sum_pixels loss((rendered - observed) / deviation) + sum_coordinates (moved / expected)^2

    over the number of pixels' values, the second sum over parts with a prior. Nothing is compiled between steps. A plan that the
    scene has outgrown is made anew, from where the scene is then.

    **Arguments:**

    - `observations`: one or more; their cameras and lights are where `CameraPoses`, `LightStrengths` and `LightPlaces` start, and
      right if these do not move. A deviation of the noise that is not given is 1% of the picture's root mean square.
    - `splats`: the body, mm, where `AlbedoMap` and `NormalOffsets` start.
    - `material`: known. `recover` finds coefficients.
    - `parts`: what may move, each kind once.
    - `optimizer`: any of optax whose update needs gradients alone. Its rate is in steps: `optax.adam(1.0)` moves each
      coordinate by a step at a time at first. A rate that falls to nothing, such as `optax.cosine_decay_schedule(1.0, steps)`,
      lets it come to rest.
    - `steps`: how many.
    - `loss`: `SquaredLoss()`, or `HuberLoss()` where some pixels are not what the model knows.
    - `background`: `UnknownBackground()`: only pixels that the body fills count. `BlackBackground()`: all that masks leave do;
      cameras and outlines are then much better told.
    - `settings`: of the renderer.
    - `progress`: told in words what is being done, and the loss.
    - `throw`: raise when a loss or gradient is not finite; otherwise `result` says so, and what was best up to then is given.

    **Returns:** a `FittedScene`: the best of all steps, in the precision of the splats.

    **Raises:** `ValueError` for no observation, part or step, for parts given twice or with nothing to move, for channels that
    disagree, for lights of unknown intensity (say `LightStrengths` instead), and for a picture none of whose pixels counts; an
    error with the message of `result` if `throw`.
    """
    observations, parts = list(observations), list(parts)
    _check(observations, splats, material, parts, steps)
    settings = RenderSettings() if settings is None else settings
    loss = SquaredLoss() if loss is None else loss
    background = UnknownBackground() if background is None else background
    say = progress or _nobody
    dtype = splats.centers.dtype
    shots = [_cast(Shot(each.camera, each.lights), dtype) for each in observations]
    world = _World.of(_cast(splats, dtype), _cast(material, dtype), parts)
    seen = _seen(Evidence(observations, dtype))
    x = _Coordinates(world.coordinates(), tuple(world.shot_coordinates(shot) for shot in shots))

    def planned(x: _Coordinates) -> list[Plan]:
        moved = [world.shot_at(shot, its) for shot, its in zip(shots, x.shots, strict=True)]
        body = world.splats_at(x.body)
        return plans_of([Scene(body, each.lights, world.material) for each in moved], [each.camera for each in moved], settings)

    def told(x: _Coordinates, plans: list[Plan]) -> list["_Told"]:
        together = zip(x.shots, shots, seen, plans, strict=True)
        return [_tell(x.body, its, world, shot, one, plan, settings, loss, background) for its, shot, one, plan in together]

    say("planning", float("nan"))
    plans, times = planned(x), 1
    with _usual_promotion():
        state = optimizer.init(x)
    best, at, losses, result = None, x, [], optx.RESULTS.successful
    for step in range(steps + 1):
        pictures = told(x, plans)
        if max(float(each.overflow) for each in pictures) > 0:
            say(f"step {step}: the scene has outgrown its plan; planning anew", losses[-1] if losses else float("nan"))
            plans, times = planned(x), times + 1
            pictures = told(x, plans)
        if step == 0:
            _check_counted(pictures)
        ahead, state, value, finite = _advance(x, state, [each.value for each in pictures], world, optimizer)
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
            "loss or gradient of the start is not finite: look for NaN in splats, lights and cameras, and for splats at a light"
        )
    moved = [world.shot_at(shot, its) for shot, its in zip(shots, at.shots, strict=True)]
    shown = [_shown(each.beauty, each.counted, one.picture) for each, one in zip(kept, seen, strict=True)]
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
    return fitted.result.error_if(fitted, True) if throw and result != optx.RESULTS.successful else fitted


class _Coordinates(eqx.Module):
    """Of every part of the body, and of every part of each picture."""

    body: tuple[PyTree[Array], ...]
    shots: tuple[tuple[PyTree[Array], ...], ...]


class _World(eqx.Module):
    """The start, and what of it may move."""

    splats: Splats
    material: Material
    middle: Float[Array, "3"]
    body: tuple[AbstractBodyPart, ...]
    prepared: tuple[PyTree[Array], ...]
    shot: tuple[AbstractShotPart, ...]

    @classmethod
    def of(cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]) -> "_World":
        body = tuple(part for part in parts if isinstance(part, AbstractBodyPart))
        shot = tuple(part for part in parts if isinstance(part, AbstractShotPart))
        for part in body:
            part.check(splats)
        return cls(splats, material, jnp.mean(splats.centers, axis=0), body, tuple(each.prepared(splats) for each in body), shot)

    def coordinates(self) -> tuple[PyTree[Array], ...]:
        return tuple(part.coordinates(self.splats) for part in self.body)

    def shot_coordinates(self, shot: Shot) -> tuple[PyTree[Array], ...]:
        return tuple(part.coordinates(shot) for part in self.shot)

    def splats_at(self, x: tuple[PyTree[Array], ...]) -> Splats:
        splats = self.splats
        for part, its, prepared in zip(self.body, x, self.prepared, strict=True):
            splats = part.moved(splats, its, prepared)
        return splats

    def shot_at(self, shot: Shot, x: tuple[PyTree[Array], ...]) -> Shot:
        for part, its in zip(self.shot, x, strict=True):
            shot = part.moved(shot, its, self.middle)
        return shot

    def unlikely(self, x: _Coordinates) -> Float[Array, ""]:
        priors = [part.unlikely(its, own) for part, its, own in zip(self.body, x.body, self.prepared, strict=True)]
        return sum(priors, jnp.zeros((), self.splats.centers.dtype))


class _Seen(eqx.Module):
    """A picture as arrays: 0 where it is not known, and which pixels may count."""

    picture: Float[Array, "height width channels"]
    deviation: Float[Array, "height width channels"]
    known: Bool[Array, "height width"]


class _Told(eqx.Module):
    """What a picture tells: its loss, and the gradient in the coordinates of the body and in its own."""

    value: tuple
    overflow: Float[Array, ""]
    beauty: Float[Array, "height width channels"]
    counted: Float[Array, "height width"]


@eqx.filter_jit
def _tell(body, own, world: _World, shot: Shot, seen: _Seen, plan: Plan, settings, loss, background) -> _Told:
    """Render a picture, and differentiate its loss."""

    def lost(x):
        body, own = x
        taken = world.shot_at(shot, own)
        frame = render(Scene(world.splats_at(body), taken.lights, world.material), taken.camera, settings, plan)
        counted = jnp.where(seen.known, background.counts(frame.coverage), 0.0)
        counts = (counted > 0)[..., None]
        residuals = jnp.where(counts, (frame.beauty - seen.picture) / seen.deviation, 0.0)
        return jnp.sum(loss.root(residuals) ** 2), (counted, frame)

    (value, (counted, frame)), gradient = jax.value_and_grad(lost, has_aux=True)((body, own))
    values = jnp.sum(counted) * frame.beauty.shape[2]
    return _Told((value, values, *gradient), frame.overflow, frame.beauty, counted)


@eqx.filter_jit
def _advance(x: _Coordinates, state, told, world: _World, optimizer: GradientTransformation):
    """Take a step; also give the loss before it, and whether all of it is finite."""
    values, counts, body, own = zip(*told, strict=True)
    unlikely, prior = jax.value_and_grad(world.unlikely)(x)
    count = jnp.maximum(jnp.sum(jnp.stack(counts)), 1.0)
    summed = jax.tree.map(lambda *each: sum(each[1:], each[0]), prior.body, *body)
    gradient = jax.tree.map(lambda leaf: leaf / count, _Coordinates(summed, own))
    value = (jnp.sum(jnp.stack(values)) + unlikely) / count
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in (value, *jax.tree.leaves(gradient))])
    with _usual_promotion():
        updates, state = optimizer.update(gradient, state, x)
    return jax.tree.map(lambda leaf, by: leaf + by, x, updates), state, value, jnp.all(finite)


@contextmanager
def _usual_promotion() -> Generator[None]:
    """Optimizers are written for JAX's usual rules, whatever the user's are."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _seen(evidence: Evidence) -> list[_Seen]:
    together = zip(evidence.pictures, evidence.deviations, evidence.masks, strict=True)
    return [
        _Seen(
            jnp.asarray(np.where(known[..., None], picture, 0.0), evidence.dtype),
            jnp.asarray(deviation, evidence.dtype),
            jnp.asarray(known),
        )
        for picture, deviation, known in together
    ]


def _shown(beauty, counted, picture) -> tuple[np.ndarray, np.ndarray]:
    """Give a picture and what it is off, NaN where it does not count."""
    made = np.where(np.asarray(counted)[..., None] > 0, np.asarray(beauty), np.nan)
    return made, made - np.asarray(picture)


def _cast(tree, dtype):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype) if eqx.is_inexact_array(leaf) else leaf, tree)


def _check(observations: list[Observation], splats: Splats, material: Material, parts: list[AbstractPart], steps: int) -> None:
    if not observations or not parts or steps < 1:
        raise ValueError(
            f"one observation, one part and one step are needed at least; got {len(observations)}, {len(parts)} and {steps}"
        )
    kinds = [type(part).__name__ for part in parts]
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"each kind of part may be given once; parts are {', '.join(kinds)}")
    channels = material.gaussians.weights.shape[1]
    for i, each in enumerate(observations):
        if each.picture.shape[2] != channels:
            raise ValueError(f"observations[{i}].picture has {each.picture.shape[2]} channels, material has {channels}")
        if not isinstance(each.intensity, KnownIntensity):
            raise ValueError(
                f"observations[{i}].intensity is {type(each.intensity).__name__}(): that is for recover; "
                "here LightStrengths among the parts lets lights be of any strength"
            )


def _check_counted(pictures: list[_Told]) -> None:
    for i, each in enumerate(pictures):
        if not np.any(np.asarray(each.counted) > 0):
            raise ValueError(
                f"no pixel of observations[{i}] counts: the splats fill none that its mask leaves and whose color is known; "
                "check camera, mask and NaN"
            )


def _nobody(said: str, loss: float) -> None:
    del said, loss
