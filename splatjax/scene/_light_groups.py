"""Samples of lights of one kind, with one array per field."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._lights import AbstractHighlight, AbstractLight, AbstractLightSample


class StackedLights(eqx.Module):
    """Stacked samples of lights of one kind, with the index of each sample's light in the scene,
    and the highlight of each light that has one.
    """

    lights: AbstractLightSample
    light_indices: tuple[int, ...] = eqx.field(static=True)
    highlights: tuple[AbstractHighlight, ...] = ()

    @property
    def distinct(self) -> tuple[int, ...]:
        """List the distinct indices of the lights."""
        return tuple(dict.fromkeys(self.light_indices))

    def mean_per_light(
        self, rows: Float[Array, "samples points"], weights: Float[Array, "samples points"]
    ) -> Float[Array, "lights points"]:
        """Average the rows of the samples of each light."""
        light, sample = jnp.asarray(self.distinct)[:, None], jnp.asarray(self.light_indices)[None]
        member = (light == sample).astype(rows.dtype)
        total = member @ weights
        mean = member @ (weights * rows) / jnp.where(total > 0, total, 1.0)
        return jnp.where(total > 0, mean, 1.0)

    def per_sample(self, rows: Float[Array, "lights points"]) -> Float[Array, "samples points"]:
        """Repeat the row of each light for its samples."""
        if len(self.distinct) == len(self.light_indices):
            return rows
        return rows[jnp.asarray([self.distinct.index(index) for index in self.light_indices])]


def lights_by_kind(
    lights: tuple[AbstractLight, ...],
) -> list[list[tuple[int, AbstractLightSample]]]:
    """List the samples of each kind of light with the indices of their lights. A light with a
    common highlight is listed separately. Kinds are sorted, so that scenes whose lights differ only
    in order share a program.
    """
    kinds: dict[object, list[tuple[int, AbstractLightSample]]] = {}
    for index, light in enumerate(lights):
        has_lobes = type(light).highlight is AbstractLight.highlight
        for sample in light.samples():
            kinds.setdefault((jax.tree.structure(sample), has_lobes), []).append((index, sample))
    return [kinds[kind] for kind in sorted(kinds, key=str)]


def light_kinds(lights: tuple[AbstractLight, ...]) -> tuple[str, ...]:
    """Name each kind of samples of lights."""
    samples = [group[0][1] for group in lights_by_kind(lights)]
    return tuple(
        type(sample).__name__ + ("" if sample.cast_shadows else " without shadows")
        for sample in samples
    )


def stack_lights(lights: tuple[AbstractLight, ...]) -> list[StackedLights]:
    """Stack samples of the same kind, so that one loop computes any number of them."""
    groups = []
    for members in lights_by_kind(lights):
        indices, samples = zip(*members, strict=True)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *samples)
        highlights = [lights[index].highlight() for index in dict.fromkeys(indices)]
        groups.append(StackedLights(stacked, indices, tuple(filter(None, highlights))))
    return groups
