"""Splats divided over devices, in the order of a plan."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Int

from splatjax import diffusion as _diffusion
from splatjax._chunking import rounded_up
from splatjax.cache import reuse_capacity
from splatjax.scene import Splats

_MOST_SPLATS = 1.06  # largest padded splat count over a scene's own count, to reuse a program


def splats_per_device(count: int, mesh: Mesh | None) -> tuple[int, int]:
    """Return the number of devices, and the number of splats of each, at least one."""
    devices = 1 if mesh is None else mesh.size
    return devices, max(-(-count // devices), 1)


def cut_and_order(splats: Splats, mesh: Mesh | None) -> tuple[list[Splats], Array, Array]:
    """Divide the splats into a part for each device, in a compact order; also return the orders,
    and whether their entries exist, device after device.
    """
    devices, per_device = splats_per_device(splats.count, mesh)
    places = rounded_up(per_device, _diffusion.POINTS_PER_BLOCK, per_octave=16)
    places = reuse_capacity("splats", per_device, places, most=_MOST_SPLATS)
    repeated = (0, places - per_device)
    padded = jax.tree.map(np.asarray, pad_splats(splats, per_device * devices))
    parts, orders, exist = [], [], []
    for first in range(0, per_device * devices, per_device):
        part = jax.tree.map(lambda leaf, i=first: leaf[i : i + per_device], padded)
        order = _diffusion.compact_order(part.centers).astype(np.int32)
        exist.append(np.pad(first + order < splats.count, repeated))
        orders.append(np.pad(order, repeated, mode="edge"))
        parts.append(jax.tree.map(jnp.asarray, arrange(part, orders[-1], exist[-1])))
    return parts, jnp.asarray(np.concatenate(orders)), jnp.asarray(np.concatenate(exist))


def pad_splats(splats: Splats, count: int) -> Splats:
    """Add invisible splats without light, up to `count`."""
    if splats.count == count:
        return splats
    return splats.take(jnp.arange(count, dtype=jnp.int32))


def arrange(
    splats: Splats,
    order: Int[Array, " places"] | Int[np.ndarray, " places"],
    exists: Bool[Array, " places"] | Bool[np.ndarray, " places"],
) -> Splats:
    """Sort a device's splats in the order of a plan; repeated ones are invisible and dark."""
    placed = jax.tree.map(lambda leaf: leaf[order], splats)
    where = np.where if isinstance(placed.radii, np.ndarray) else jnp.where
    return eqx.tree_at(
        lambda splats: (splats.normals, splats.radii, splats.areas),
        placed,
        replace_fn=lambda leaf: where(exists.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0),
    )
