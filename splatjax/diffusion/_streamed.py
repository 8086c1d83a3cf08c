"""Pass 4 with splats that are read part by part, at the visible points: each part adds to their
sums, and is released.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._combination import PartByPart
from splatjax.scene import Material

from ._clustered import ClusterDiffuser, layer_sums, per_flat_mass, source_boxes
from ._clusters import LayerSources, compact_order
from ._diffuser import Sources
from ._gaussian_sums import FAR
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian
from ._neighbors import Boxes, find_neighbors, pairs_in_reach


def streamed_layers(
    parts: Iterable[Sources],
    diffuser: ClusterDiffuser,
    kernel: AbstractDiffusionKernel,
    material: Material,
    spacing: float,
    fine: float,
    interval: Float[Array, "2"],
    points: Float[Array, "blocks 3 block"],
    exists: Bool[Array, "blocks block"],
) -> tuple[Int[Array, " layers"], Float[Array, "blocks layers values block"]]:
    """Evaluate the layers at points, from sources in parts.

    Each part has its own cells, so a cell that two parts share counts as two, and cells are never
    coarser than those of all splats together. Only the sums are kept, which do not grow with the
    number of splats.

    **Arguments:**

    - `parts`: parts of one size, with centers from the origin of the points; sources without area
      do not count.
    - `spacing`, `fine`, `interval`: as for `ClusterDiffuser.choose_layers`.
    - `points`, `exists`: in compact blocks.

    **Returns:** the Gaussian of each layer; means and mass of each layer.
    """
    variances = material.gaussians.variances
    gaussians, sizes, edges, supports = diffuser.choose_layers(
        np.asarray(variances, np.float64), spacing, fine, kernel, interval
    )
    reaches = np.where(edges < np.inf, supports * np.sqrt(sizes), 0)
    gaussians, variances = jnp.asarray(gaussians, jnp.int32), jnp.asarray(sizes, variances.dtype)
    depths, kernels = kernel.depths(variances), kernel.truncated(supports)
    # Sources are below their splats.
    reach = np.max(reaches + np.asarray(depths, np.float64))
    points = jnp.where(exists[:, None], points, FAR)
    boxes = Boxes.around(
        jnp.moveaxis(points, 1, 0).reshape(3, -1), exists.reshape(-1), points.shape[2]
    )

    def add(sums: Float[Array, "layers values points"], sources: Sources):
        around = Boxes.around(sources.centers, sources.areas > 0, len(sources.areas))
        if not len(pairs_in_reach(boxes.corners, around.corners, reach)[0]):
            return sums
        order = compact_order(np.asarray(sources.centers.T))
        sources = jax.tree.map(lambda rows: rows[..., order], sources.of_layers(gaussians))
        centers, normals = (np.asarray(rows).T for rows in (sources.centers, sources.normals))
        exists = np.asarray(sources.areas) > 0
        clusters = LayerSources.build(centers, normals, exists, edges.tolist())
        below, layers = clusters.merged(sources, depths), clusters.layers
        lists = find_neighbors(boxes, source_boxes(below), layers, reaches.tolist())
        return sums + layer_sums(points, below, layers, lists, variances, kernels, moments=False)

    count = points.shape[0] * points.shape[2]
    zeros = jnp.zeros((len(edges), material.channels + 1, count), points.dtype)
    sums = PartByPart().fold(add, zeros, parts)
    return gaussians, _means_and_mass(sums, variances, depths, kernels, points)


@eqx.filter_jit
def _means_and_mass(sums, variances, depths, kernels: TruncatedGaussian, points):
    """Divide the light of each channel by the mass, which comes last; 0 where nothing is in
    reach.
    """
    light, mass = sums[:, :-1], sums[:, -1:]
    per_flat = per_flat_mass(kernels, variances, depths)[:, None, None]
    rows = jnp.concatenate([light / jnp.where(mass > 0, mass, 1.0), per_flat * mass], axis=1)
    return jnp.moveaxis(rows.reshape(*rows.shape[:2], points.shape[0], points.shape[2]), 2, 0)
