"""Combination of partial results of parts of the splats. One device has one part, a mesh has one
part per device, and a stream is a sequence of parts.
"""

import abc
import functools
from collections.abc import Callable, Iterable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PyTree, Shaped

Part = TypeVar("Part")
Partial = TypeVar("Partial", bound=PyTree)


class AbstractCombination(eqx.Module):
    """A rule that combines the results of parts. Static.

    Its methods take an iterable with one partial result for each part of this process.
    """

    @abc.abstractmethod
    def total(self, partials: Iterable[Partial]) -> Partial:
        """Sum over all parts. Differentiable."""

    @abc.abstractmethod
    def largest(self, partials: Iterable[Partial]) -> Partial:
        """Take the maximum over all parts; it is a constant for differentiation."""

    def fold(
        self, add: Callable[[Partial, Part], Partial], start: Partial, parts: Iterable[Part]
    ) -> Partial:
        """Add the parts on this device to an initial value, one after the other: `add(so_far,
        part)` returns the sum. Differentiable.
        """
        return functools.reduce(add, parts, start)


class DeviceMesh(AbstractCombination):
    """Combine one part per device of a mesh by JAX's collectives, inside `jax.shard_map`. Without
    axes there is one device, and the collectives do nothing.
    """

    axes: tuple[str, ...] = eqx.field(static=True, default=())
    count: int = eqx.field(static=True, default=1)

    @classmethod
    def of(cls, mesh: Mesh) -> "DeviceMesh":
        return cls(tuple(mesh.axis_names), mesh.size)

    @property
    def shares(self) -> PartitionSpec:
        """Return the specification that cuts rows into one share per device."""
        return PartitionSpec(self.axes)

    def total(self, partials):
        (part,) = partials
        return jax.lax.psum(part, self.axes)

    def largest(self, partials):
        (part,) = partials
        return jax.tree.map(lambda leaf: jax.lax.pmax(jax.lax.stop_gradient(leaf), self.axes), part)

    def own_share(self, rows: Partial) -> Partial:
        """Sum the rows of all devices, and keep this device's share of them. Differentiable."""
        return jax.lax.psum_scatter(rows, self.axes, scatter_dimension=0, tiled=True)

    def own_rows(self, rows: Shaped[Array, "rows ..."]) -> Shaped[Array, "share ..."]:
        """Keep this device's share of rows that are the same on all devices."""
        share = rows.shape[0] // self.count
        return jax.lax.dynamic_slice_in_dim(rows, jax.lax.axis_index(self.axes) * share, share)

    def gather(self, share: Partial, axis: int = 0) -> Partial:
        """Concatenate the shares of all devices along an axis. Differentiable."""
        return jax.tree.map(
            lambda rows: jax.lax.all_gather(rows, self.axes, axis=axis % rows.ndim, tiled=True),
            share,
        )


class PartByPart(AbstractCombination):
    """Compute parts one after the other, and keep only their results."""

    def total(self, partials):
        return self._combine(jnp.add, partials)

    def largest(self, partials):
        return self._combine(jnp.maximum, partials)

    def _combine(self, operation: Callable[[Array, Array], Array], partials: Iterable[Partial]):
        remaining = iter(partials)
        return self.fold(functools.partial(jax.tree.map, operation), next(remaining), remaining)

    def fold(self, add, start, parts):
        # Wait; otherwise parts that are read ahead of the computation accumulate in memory.
        return functools.reduce(lambda *pair: jax.block_until_ready(add(*pair)), parts, start)


def extreme(
    values: Float[Array, "rows *more"], combination: AbstractCombination
) -> Float[Array, "*more"]:
    """Take the maximum over the rows of all parts. Equal rows share the derivative."""
    largest = combination.largest([jnp.max(values, axis=0)])
    equal = values == largest[None]
    sums = (
        jnp.sum(jnp.where(equal, values, 0), axis=0),
        jnp.sum(equal, axis=0).astype(values.dtype),
    )
    total, count = combination.total([sums])
    return largest + total / count - jax.lax.stop_gradient(total / count)


def lay_out(mesh: Mesh, trees: Partial, specs: PyTree[PartitionSpec]) -> Partial:
    """Distribute trees of arrays over a mesh with explicit axes, by one specification per tree or
    array. For other meshes `shard_map` does this itself.
    """
    if AxisType.Explicit not in mesh.axis_types:
        return trees
    return jax.tree.map(
        lambda spec, tree: jax.reshard(tree, NamedSharding(mesh, spec)), specs, trees
    )
