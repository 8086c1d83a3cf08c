"""Pass 4 with splats that are read part by part, at the visible points: each part adds to their
sums, and is released.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax._combination import PartByPart

from ._clustered import ClusterDiffuser, layer_sums, per_flat_mass, source_boxes
from ._clusters import LayerSources, compact_order
from ._diffuser import Sources
from ._gaussian_sums import FAR
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian
from ._neighbors import Boxes, find_neighbors, pairs_in_reach


class StreamedDiffusion:
    """Evaluates the layers at points, from sources in parts.

    Each part has its own cells, so a cell that two parts share counts as two, and cells are never
    coarser than those of all splats together. Only the sums are kept, which do not grow with the
    number of splats.
    """

    def __init__(
        self,
        diffuser: ClusterDiffuser,
        kernel: AbstractDiffusionKernel,
        variances: Float[Array, " gaussians"],
        spacing: float,
        fine: float,
        interval: Float[Array, "2"],
        points: Float[Array, "blocks 3 block"],
        exists: Bool[Array, "blocks block"],
    ):
        """Prepare for points in compact blocks; `spacing`, `fine` and `interval` as for
        `ClusterDiffuser.choose_layers`.
        """
        gaussians, sizes, edges, supports = diffuser.choose_layers(
            np.asarray(variances, np.float64), spacing, fine, kernel, interval
        )
        self.gaussians = jnp.asarray(gaussians, jnp.int32)
        self.variances, self.edges = jnp.asarray(sizes, variances.dtype), edges.tolist()
        self.depths, self.kernels = kernel.depths(self.variances), kernel.truncated(supports)
        self.reaches = np.where(edges < np.inf, supports * np.sqrt(sizes), 0).tolist()
        self.points = jnp.where(exists[:, None], points, FAR)
        self.boxes = Boxes.around(
            jnp.moveaxis(self.points, 1, 0).reshape(3, -1), exists.reshape(-1), points.shape[2]
        )

    def evaluate(
        self, parts: Iterable[Sources], channels: int
    ) -> Float[Array, "blocks layers values block"]:
        """Sum over all parts: means and mass of each layer, in the order of `gaussians`.

        **Arguments:**

        - `parts`: parts of one size, with centers from the origin of the points; sources without
          area do not count.
        - `channels`: number of channels of their irradiance.
        """

        def add(sums: Float[Array, "layers values points"], sources: Sources):
            return sums + self._sum_part(sources) if self._in_reach(sources) else sums

        count = self.points.shape[0] * self.points.shape[2]
        zeros = jnp.zeros((len(self.edges), channels + 1, count), self.points.dtype)
        sums = PartByPart().fold(add, zeros, parts)
        return _means_and_mass(sums, self.variances, self.depths, self.kernels, self.points)

    def _in_reach(self, sources: Sources) -> bool:
        """Test by boxes whether a part may contribute to any point."""
        around = Boxes.around(sources.centers, sources.areas > 0, len(sources.areas))
        # Sources are below their splats.
        reach = np.max(self.reaches + np.asarray(self.depths, np.float64))
        return len(pairs_in_reach(self.boxes.corners, around.corners, reach)[0]) > 0

    def _sum_part(self, sources: Sources) -> Float[Array, "layers values points"]:
        order = compact_order(np.asarray(sources.centers.T))
        sources = jax.tree.map(lambda rows: rows[..., order], sources.of_layers(self.gaussians))
        arrays = (np.asarray(rows.T) for rows in (sources.centers, sources.normals))
        clusters = LayerSources.build(*arrays, np.asarray(sources.areas) > 0, self.edges)
        below, layers = clusters.merged(sources, self.depths), clusters.layers
        lists = find_neighbors(self.boxes, source_boxes(below), layers, self.reaches)
        return layer_sums(
            self.points, below, layers, lists, self.variances, self.kernels, moments=False
        )


@eqx.filter_jit
def _means_and_mass(sums, variances, depths, kernels: TruncatedGaussian, points):
    """Divide the light of each channel by the mass, which comes last; 0 where nothing is in
    reach.
    """
    light, mass = sums[:, :-1], sums[:, -1:]
    per_flat = per_flat_mass(kernels, variances, depths)[:, None, None]
    rows = jnp.concatenate([light / jnp.where(mass > 0, mass, 1.0), per_flat * mass], axis=1)
    return jnp.moveaxis(rows.reshape(*rows.shape[:2], points.shape[0], points.shape[2]), 2, 0)
