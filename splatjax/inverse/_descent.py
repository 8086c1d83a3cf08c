"""A step along the gradient of pictures: the parts that move, the loss of each picture, and the
step of the optimizer.
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
from ._parts import AbstractBodyPart, AbstractPart, AbstractSetupPart, PictureSetup


@runtime_checkable
class GradientTransformation(Protocol):
    """An optimizer of optax: a pair of functions."""

    init: Callable[..., Any]
    update: Callable[..., Any]


class Coordinates(eqx.Module):
    """The coordinates of every part of the body, and of every part of each picture."""

    body: tuple[PyTree[Array], ...]
    setups: tuple[tuple[PyTree[Array], ...], ...]


class MovableScene(eqx.Module):
    """The scene at the start, and its parts that may move."""

    splats: Splats
    material: Material
    middle: Float[Array, "3"]
    body: tuple[AbstractBodyPart, ...]
    prepared: tuple[PyTree[Array], ...]
    setup: tuple[AbstractSetupPart, ...]

    @classmethod
    def of(
        cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]
    ) -> "MovableScene":
        body = tuple(part for part in parts if isinstance(part, AbstractBodyPart))
        setup = tuple(part for part in parts if isinstance(part, AbstractSetupPart))
        for part in body:
            part.check(splats)
        prepared = tuple(part.prepared(splats) for part in body)
        return cls(splats, material, jnp.mean(splats.centers, axis=0), body, prepared, setup)

    def coordinates(self, setups: Sequence[PictureSetup]) -> Coordinates:
        """Return the coordinates of the start: zeros."""
        return Coordinates(
            tuple(part.coordinates(self.splats) for part in self.body),
            tuple(tuple(part.coordinates(setup) for part in self.setup) for setup in setups),
        )

    def splats_at(self, x: tuple[PyTree[Array], ...]) -> Splats:
        splats = self.splats
        for part, steps, prepared in zip(self.body, x, self.prepared, strict=True):
            splats = part.moved(splats, steps, prepared)
        return splats

    def setup_at(self, setup: PictureSetup, x: tuple[PyTree[Array], ...]) -> PictureSetup:
        for part, steps in zip(self.setup, x, strict=True):
            setup = part.moved(setup, steps, self.middle)
        return setup

    def prior(self, x: Coordinates) -> Float[Array, ""]:
        priors = [
            part.prior(steps, prepared)
            for part, steps, prepared in zip(self.body, x.body, self.prepared, strict=True)
        ]
        return sum(priors, jnp.zeros((), self.splats.centers.dtype))


class ObservedPicture(eqx.Module):
    """A picture as arrays: 0 where it is unknown, and which pixels may count."""

    picture: Float[Array, "height width channels"]
    deviation: Float[Array, "height width channels"]
    known: Bool[Array, "height width"]


class Evaluation(eqx.Module):
    """A rendered picture and its loss: the sum over its values, their number, and the gradient in
    the coordinates of the body and of the picture.
    """

    value: tuple
    overflow: Float[Array, ""]
    beauty: Float[Array, "height width channels"]
    counted: Float[Array, "height width"]


@eqx.filter_jit
def evaluate(
    body,
    own,
    scene: MovableScene,
    setup: PictureSetup,
    observed: ObservedPicture,
    plan: Plan,
    settings,
    loss,
    background,
) -> Evaluation:
    """Render a picture at coordinates of the body and its own, and differentiate its loss."""

    def total_loss(x):
        body, own = x
        moved = scene.setup_at(setup, own)
        rendered = Scene(scene.splats_at(body), moved.lights, scene.material)
        frame = render(rendered, moved.camera, settings, plan)
        counted = jnp.where(observed.known, background.counts(frame.coverage), 0.0)
        residuals = (frame.beauty - observed.picture) / observed.deviation
        residuals = jnp.where((counted > 0)[..., None], residuals, 0.0)
        return jnp.sum(loss.root(residuals) ** 2), (counted, frame)

    (value, (counted, frame)), gradient = jax.value_and_grad(total_loss, has_aux=True)((body, own))
    values = jnp.sum(counted) * frame.beauty.shape[2]
    return Evaluation((value, values, *gradient), frame.overflow, frame.beauty, counted)


@eqx.filter_jit
def advance(x: Coordinates, state, values, scene: MovableScene, optimizer: GradientTransformation):
    """Take a step; also return the loss before it, and whether loss and gradient are finite."""
    losses, counts, body, own = zip(*values, strict=True)
    prior, prior_gradient = jax.value_and_grad(scene.prior)(x)
    count = jnp.maximum(jnp.sum(jnp.stack(counts)), 1.0)
    summed = jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), prior_gradient.body, *body)
    gradient = jax.tree.map(lambda leaf: leaf / count, Coordinates(summed, own))
    loss = (jnp.sum(jnp.stack(losses)) + prior) / count
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, gradient))])
    with standard_promotion():
        updates, state = optimizer.update(gradient, state, x)
    return jax.tree.map(lambda leaf, by: leaf + by, x, updates), state, loss, jnp.all(finite)


@contextmanager
def standard_promotion() -> Generator[None]:
    """Use JAX's default rules, for which optimizers are written, whatever the user has set."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def observed_pictures(evidence: Evidence) -> list[ObservedPicture]:
    """Convert observations to arrays of the precision of the computation."""
    together = zip(evidence.pictures, evidence.deviations, evidence.masks, strict=True)
    return [
        ObservedPicture(
            jnp.asarray(np.where(known[..., None], picture, 0.0), evidence.dtype),
            jnp.asarray(deviation, evidence.dtype),
            jnp.asarray(known),
        )
        for picture, deviation, known in together
    ]
