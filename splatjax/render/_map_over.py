"""Functions of many pictures, divided over the devices of a mesh."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import PyTree

from splatjax._combination import DeviceMesh, lay_out

from ._devices import rows_or_last


def map_over(
    mesh: Mesh, function: Callable[[Any, Any], PyTree], shared: PyTree, batch: PyTree
) -> PyTree:
    r"""Apply a function to every element of a batch, with the elements divided among the devices of
    a mesh. Each device computes its elements one after the other, like `jax.lax.map`.

        mesh = jax.make_mesh((jax.device_count(),), ("views",))
        batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
        frames = map_over(mesh, lambda s, camera: render(s, camera, plan=plan), scene, batch)

    **Arguments:**

    - `mesh`: a mesh of any axes; all its devices are used.
    - `function`: a pure function of `shared` and one element; the same function is compiled once.
    - `shared`: replicated on every device. Differentiable.
    - `batch`: a tree of arrays with the elements along the first axis, any number; static parts are
      shared. Differentiable.

    **Returns:** the results, stacked along a new first axis. If the number of devices divides the
    number of elements, this axis stays divided among the devices; otherwise every device has all
    results.

    **Raises:** `ValueError` if the batch is empty, or its arrays have different lengths.
    """
    arrays = jax.tree_util.tree_leaves_with_path(eqx.filter(batch, eqx.is_array))
    shapes = {jax.tree_util.keystr(path): list(leaf.shape) for path, leaf in arrays}
    lengths = {tuple(shape[:1]) for shape in shapes.values()}
    if len(lengths) != 1 or lengths & {(), (0,)}:
        raise ValueError(
            "the arrays of a batch must have one length along their first axis, not zero; these "
            f"have the shapes {shapes}; stack them, or share those that have no such axis"
        )
    return _map_over(mesh, function, shared, batch)


@eqx.filter_jit
def _map_over(mesh: Mesh, function: Callable, shared: PyTree, batch: PyTree) -> PyTree:
    devices = DeviceMesh.of(mesh)
    count = len(jax.tree.leaves(eqx.filter(batch, eqx.is_array))[0])
    places = np.arange(count + -count % devices.count)
    arrays, static = eqx.partition((shared, batch), eqx.is_array)
    arrays = arrays[0], jax.tree.map(lambda leaf: rows_or_last(leaf, places), arrays[1])

    def share(shared, batch):
        replicated = eqx.combine(shared, static[0])
        return jax.lax.map(lambda item: function(replicated, eqx.combine(item, static[1])), batch)

    specs = PartitionSpec(), devices.shares
    mapped = jax.shard_map(
        share, mesh=mesh, in_specs=specs, out_specs=devices.shares, check_vma=False
    )
    results = mapped(*lay_out(mesh, arrays, specs))
    if len(places) == count:
        return results
    replicated = lay_out(mesh, results, PartitionSpec())
    return jax.tree.map(lambda leaf: leaf[:count], replicated)
