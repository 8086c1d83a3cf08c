"""A step along the gradient of pictures: the parts that move, the loss of each picture, and the
step of the optimizer.
"""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax.render import Plan, RenderSettings, render
from splatjax.scene import Material, Scene, Splats

from ._losses import (
    AbstractBackground,
    AbstractLoss,
)
from ._observation import Evidence
from ._parts import AbstractPart, Setup

Coordinates = tuple[PyTree[Array], ...]
"""Of each part; where pictures do not share it, a tuple with those of each picture."""


@runtime_checkable
class GradientTransformation(Protocol):
    """An optimizer of optax: a pair of functions."""

    init: Callable[..., Any]
    update: Callable[..., Any]


class MovableScene(eqx.Module):
    """The material, and the parts of the scene that may move."""

    material: Material
    parts: tuple[AbstractPart, ...]
    prepared: tuple[PyTree[Array], ...]

    @classmethod
    def of(
        cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]
    ) -> "MovableScene":
        return cls(material, tuple(parts), tuple(part.prepared(splats) for part in parts))

    def start(self, setups: Sequence[Setup]) -> Coordinates:
        """Return the coordinates of the start: zeros."""
        return tuple(
            part.coordinates(setups[0])
            if part.shared
            else tuple(part.coordinates(setup) for setup in setups)
            for part in self.parts
        )

    def of_picture(self, x: Coordinates, number: int) -> Coordinates:
        """Select the coordinates that a picture depends on."""
        return tuple(
            own if part.shared else own[number] for part, own in zip(self.parts, x, strict=True)
        )

    def of_all(self, pictures: Sequence[Coordinates]) -> Coordinates:
        """Combine derivatives in the coordinates of each picture: add those of shared parts."""
        return tuple(
            jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *own) if part.shared else own
            for part, own in zip(self.parts, zip(*pictures, strict=True), strict=True)
        )

    def moved(self, setup: Setup, x: Coordinates) -> Setup:
        """Move the parts of a picture."""
        for part, own, prepared in zip(self.parts, x, self.prepared, strict=True):
            setup = part.moved(setup, own, prepared)
        return setup

    def prior(self, x: Coordinates) -> Float[Array, ""] | float:
        return sum(
            part.prior(one, prepared)
            for part, own, prepared in zip(self.parts, x, self.prepared, strict=True)
            for one in ((own,) if part.shared else own)
        )


class Evaluation(eqx.Module):
    """A rendered picture and its loss: the sum over its values, their number, and the gradient in
    the coordinates of the picture.
    """

    loss: Float[Array, ""]
    count: Float[Array, ""]
    gradient: Coordinates
    overflow: Float[Array, ""]
    beauty: Float[Array, "height width channels"]
    counted: Float[Array, "height width"]


@eqx.filter_jit
def evaluate(
    x: Coordinates,
    scene: MovableScene,
    setup: Setup,
    evidence: Evidence,
    plan: Plan,
    settings: RenderSettings,
    loss: AbstractLoss,
    background: AbstractBackground,
) -> Evaluation:
    """Render a picture at its coordinates, and differentiate its loss."""

    def total_loss(x):
        moved = scene.moved(setup, x)
        rendered = Scene(moved.splats, moved.lights, scene.material)
        frame = render(rendered, moved.camera, settings, plan)
        counted = jnp.where(evidence.known, background.counts(frame.coverage), 0.0)
        residuals = (frame.beauty - evidence.picture) / evidence.deviation
        residuals = jnp.where((counted > 0)[..., None], residuals, 0.0)
        return jnp.sum(loss.root(residuals) ** 2), (counted, frame)

    (value, (counted, frame)), gradient = jax.value_and_grad(total_loss, has_aux=True)(x)
    count = jnp.sum(counted) * frame.beauty.shape[2]
    return Evaluation(value, count, gradient, frame.overflow, frame.beauty, counted)


@eqx.filter_jit
def advance(
    x: Coordinates,
    state: PyTree,
    evaluated: Sequence[tuple[Array, Array, Coordinates]],
    scene: MovableScene,
    optimizer: GradientTransformation,
):
    """Take a step; also return the loss before it, and whether loss and gradient are finite.

    **Arguments:**

    - `evaluated`: the loss of each picture, the number of its values, and its gradient.
    """
    losses, counts, gradients = zip(*evaluated, strict=True)
    prior, prior_gradient = jax.value_and_grad(lambda x: jnp.asarray(scene.prior(x)))(x)
    count = jnp.maximum(jnp.sum(jnp.stack(counts)), 1.0)
    gradient = jax.tree.map(
        lambda *leaves: sum(leaves) / count, scene.of_all(gradients), prior_gradient
    )
    loss = (jnp.sum(jnp.stack(losses)) + prior) / count
    finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves((loss, gradient))])
    with standard_promotion():
        updates, state = optimizer.update(gradient, state, x)
    return jax.tree.map(jnp.add, x, updates), state, loss, jnp.all(finite)


@contextmanager
def standard_promotion() -> Generator[None]:
    """Use JAX's default rules, for which optimizers are written, whatever the user has set."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield
