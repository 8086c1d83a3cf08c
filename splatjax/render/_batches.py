"""Many pictures, materials or lights at once, a share of them on each device of a mesh."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from splatjax._combination import DeviceMesh, lay_out


def map_over(
    mesh: Mesh, function: Callable[[Any, Any], PyTree], shared: PyTree, batch: PyTree
) -> PyTree:
    r"""Apply a function to each of a batch, a share of them on each device of a mesh, one after the
    other.

        frames = map_over(mesh, lambda scene, camera: render(scene, camera, plan=plan), scene,
        cameras)

    **Arguments:**

    - `mesh`: whatever its axes; all its devices take part.
    - `function`: of `shared` and of one element. Pure; where it is the same function again, nothing
      is compiled again.
    - `shared`: what every device has whole. Differentiable.
    - `batch`: a tree of arrays, their elements along the first axis, of any number; static parts
      belong to all. Differentiable.

    **Returns:** what the function gives, stacked along a first axis, which is cut over the devices
    if they divide it.

    **Raises:** `ValueError` when the batch is empty, or its arrays are not of one length.
    """
    arrays = jax.tree_util.tree_leaves_with_path(eqx.filter(batch, eqx.is_array))
    single = [jax.tree_util.keystr(path) for path, leaf in arrays if leaf.ndim == 0]
    if single:
        raise ValueError(
            f"a batch is stacked along a first axis, and {', '.join(single)} has none; stack it, "
            "or share it"
        )
    counts = sorted({leaf.shape[0] for _, leaf in arrays})
    if len(counts) != 1 or counts[0] == 0:
        raise ValueError(
            "the arrays of a batch must have one length along their first axis, not zero; these "
            f"have {counts}"
        )
    return _map_over(mesh, function, shared, batch, counts[0])


@eqx.filter_jit
def _map_over(mesh: Mesh, function: Callable, shared: PyTree, batch: PyTree, count: int) -> PyTree:
    devices = DeviceMesh.of(mesh)
    lacking = -count % devices.count
    arrays, static = eqx.partition((shared, batch), eqx.is_array)
    if lacking:
        last = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[-1:], (lacking, *leaf.shape[1:])), arrays[1]
        )
        arrays = arrays[0], jax.tree.map(lambda *leaves: jnp.concatenate(leaves), arrays[1], last)

    def share(shared, batch):
        whole = eqx.combine(shared, static[0])
        return jax.lax.map(lambda one: function(whole, eqx.combine(one, static[1])), batch)

    specs = (
        jax.tree.map(lambda _: PartitionSpec(), arrays[0]),
        jax.tree.map(lambda _: devices.shares, arrays[1]),
    )
    mapped = jax.shard_map(
        share, mesh=mesh, in_specs=specs, out_specs=devices.shares, check_vma=False
    )
    found = mapped(*lay_out(mesh, arrays, specs))
    if not lacking:
        return found
    whole = lay_out(mesh, found, jax.tree.map(lambda _: PartitionSpec(), found))
    return jax.tree.map(lambda leaf: leaf[:count], whole)
