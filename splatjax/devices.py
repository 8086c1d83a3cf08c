"""How devices that each hold a part of the splats find what holds for all: inside `jax.shard_map`,
by JAX's own collectives.
"""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PyTree

Parts = TypeVar("Parts", bound=PyTree)


class Devices(eqx.Module):
    """The devices of a mesh, one after the other, whatever its axes. Static."""

    axes: tuple[str, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @classmethod
    def of(cls, mesh: Mesh) -> "Devices":
        return cls(tuple(mesh.axis_names), mesh.size)

    @property
    def shares(self) -> PartitionSpec:
        """Say that rows are cut, a share for each device."""
        return PartitionSpec(self.axes)

    def index(self) -> Array:
        """Number this device."""
        return jax.lax.axis_index(self.axes)

    def largest(self, parts: Parts) -> Parts:
        """Return the largest of the values of all devices. A constant of the derivative: `lax.pmax`
        has none.
        """
        return jax.tree.map(lambda part: jax.lax.pmax(stop_gradient(part), self.axes), parts)

    def total(self, parts: Parts) -> Parts:
        """Add up what the devices found. Differentiable."""
        return jax.lax.psum(parts, self.axes)

    def own_share(self, rows: Float[Array, "rows ..."]) -> Float[Array, "share ..."]:
        """Add up what the devices found, of this device's share of the rows alone.
        Differentiable.
        """
        return jax.lax.psum_scatter(rows, self.axes, scatter_dimension=0, tiled=True)

    def everything(self, share: Parts) -> Parts:
        """Put the shares of all devices one after the other. Differentiable."""
        return jax.tree.map(
            lambda rows: jax.lax.all_gather(rows, self.axes, axis=0, tiled=True), share
        )

    def extreme(self, values: Float[Array, "rows *more"], largest: bool) -> Float[Array, "*more"]:
        """Return the largest (or the least) of all rows. Equal rows share the derivative, as for
        `jnp.max`.
        """
        sign = 1 if largest else -1
        found = sign * self.largest(jnp.max(sign * values, axis=0))
        there = values == found[None]
        mean = self.total(jnp.sum(jnp.where(there, values, 0), axis=0)) / self.total(
            jnp.sum(there, axis=0).astype(values.dtype)
        )
        return found + mean - stop_gradient(mean)


def laid_out(mesh: Mesh, trees: Parts, specs: Parts) -> Parts:
    """Lay arrays out over a mesh whose axes are explicit; where they are not, `shard_map` does so
    itself.
    """
    if AxisType.Explicit not in mesh.axis_types:
        return trees
    return jax.tree.map(
        lambda leaf, spec: jax.reshard(leaf, NamedSharding(mesh, spec)), trees, specs
    )
