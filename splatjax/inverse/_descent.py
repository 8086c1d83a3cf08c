"""A step along the gradient of pictures: what moves, what each picture tells, and where the
optimizer goes.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from splatjax.render import Plan, render
from splatjax.scene import Material, Scene, Splats

from ._evidence import Evidence
from ._parts import AbstractBodyPart, AbstractPart, AbstractShotPart, Shot


@runtime_checkable
class GradientTransformation(Protocol):
    """What optax calls so: a pair of functions."""

    init: Callable[..., Any]
    update: Callable[..., Any]


class Coordinates(eqx.Module):
    """Of every part of the body, and of every part of each picture."""

    body: tuple[PyTree[Array], ...]
    shots: tuple[tuple[PyTree[Array], ...], ...]


class World(eqx.Module):
    """The start, and what of it may move."""

    splats: Splats
    material: Material
    middle: Float[Array, "3"]
    body: tuple[AbstractBodyPart, ...]
    prepared: tuple[PyTree[Array], ...]
    shot: tuple[AbstractShotPart, ...]

    @classmethod
    def of(cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]) -> "World":
        body = tuple(part for part in parts if isinstance(part, AbstractBodyPart))
        shot = tuple(part for part in parts if isinstance(part, AbstractShotPart))
        for part in body:
            part.check(splats)
        return cls(
            splats,
            material,
            jnp.mean(splats.centers, axis=0),
            body,
            tuple(each.prepared(splats) for each in body),
            shot,
        )

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

    def unlikely(self, x: Coordinates) -> Float[Array, ""]:
        priors = [
            part.unlikely(its, own)
            for part, its, own in zip(self.body, x.body, self.prepared, strict=True)
        ]
        return sum(priors, jnp.zeros((), self.splats.centers.dtype))


class Seen(eqx.Module):
    """A picture as arrays: 0 where it is not known, and which pixels may count."""

    picture: Float[Array, "height width channels"]
    deviation: Float[Array, "height width channels"]
    known: Bool[Array, "height width"]


class Told(eqx.Module):
    """What a picture tells: its loss, and the gradient in the coordinates of the body and in its
    own.
    """

    value: tuple
    overflow: Float[Array, ""]
    beauty: Float[Array, "height width channels"]
    counted: Float[Array, "height width"]


@eqx.filter_jit
def tell(
    body, own, world: World, shot: Shot, seen: Seen, plan: Plan, settings, loss, background
) -> Told:
    """Render a picture, and differentiate its loss."""

    def lost(x):
        body, own = x
        taken = world.shot_at(shot, own)
        frame = render(
            Scene(world.splats_at(body), taken.lights, world.material), taken.camera, settings, plan
        )
        counted = jnp.where(seen.known, background.counts(frame.coverage), 0.0)
        counts = (counted > 0)[..., None]
        residuals = jnp.where(counts, (frame.beauty - seen.picture) / seen.deviation, 0.0)
        return jnp.sum(loss.root(residuals) ** 2), (counted, frame)

    (value, (counted, frame)), gradient = jax.value_and_grad(lost, has_aux=True)((body, own))
    values = jnp.sum(counted) * frame.beauty.shape[2]
    return Told((value, values, *gradient), frame.overflow, frame.beauty, counted)


@eqx.filter_jit
def advance(x: Coordinates, state, told, world: World, optimizer: GradientTransformation):
    """Take a step; also give the loss before it, and whether all of it is finite."""
    values, counts, body, own = zip(*told, strict=True)
    unlikely, prior = jax.value_and_grad(world.unlikely)(x)
    count = jnp.maximum(jnp.sum(jnp.stack(counts)), 1.0)
    summed = jax.tree.map(lambda *each: sum(each[1:], each[0]), prior.body, *body)
    gradient = jax.tree.map(lambda leaf: leaf / count, Coordinates(summed, own))
    value = (jnp.sum(jnp.stack(values)) + unlikely) / count
    finite = jnp.stack(
        [jnp.all(jnp.isfinite(leaf)) for leaf in (value, *jax.tree.leaves(gradient))]
    )
    with usual_promotion():
        updates, state = optimizer.update(gradient, state, x)
    return jax.tree.map(lambda leaf, by: leaf + by, x, updates), state, value, jnp.all(finite)


@contextmanager
def usual_promotion() -> Generator[None]:
    """Optimizers are written for JAX's usual rules, whatever the user's are."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def pictures_of(evidence: Evidence) -> list[Seen]:
    """Put what was seen into arrays of the precision that is computed in."""
    together = zip(evidence.pictures, evidence.deviations, evidence.masks, strict=True)
    return [
        Seen(
            jnp.asarray(np.where(known[..., None], picture, 0.0), evidence.dtype),
            jnp.asarray(deviation, evidence.dtype),
            jnp.asarray(known),
        )
        for picture, deviation, known in together
    ]
