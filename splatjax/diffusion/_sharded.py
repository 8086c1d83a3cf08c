"""Pass 4 with the splats cut over devices: sums over splats meet at the pixels, sums over cells in
the clusters.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax.devices import Devices
from splatjax.scene import Splats
from splatjax.splatting import Atlas, BinCapacity

from ._clustered import ClusterDiffuser, LayerPlan
from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources
from ._gathering import Gathering
from ._gaussian_sums import as_they_are
from ._order import compact_order
from ._pixels import Pixels
from ._tree import Clusters, ClusterTree, blocks_of


class ShardedDiffuser(AbstractDiffuser):
    r"""A diffuser of the splats of all devices, that each calls with its own splats and its own
    pixels, inside `jax.shard_map`.

    Layers of single splats: every device sums over its own, at the pixels of all. Wider ones: the
    cells of one tree for all are summed once, and each device evaluates them for its own pixels.

    **Attributes:**

    - `whole`: made for all splats; its tree begins with the first cells.
    - `order`: of each device's splats, the compact one; the number of its splats, which is none,
      fills the last block.
    - `parents`: the first cell of the splat at every place.
    - `cells`: how many first cells there are; `None` where no layer is wide. Static.
    - `splats`: how many splats there are on all devices, without those that fill their shares.
      Static.
    """

    whole: ClusterDiffuser
    devices: Devices
    order: Int[Array, " places"]
    parents: Int[Array, " places"]
    cells: int | None = eqx.field(static=True)
    splats: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        whole: ClusterDiffuser,
        splats: Splats,
        parts: Sequence[Splats],
        kernels: Kernels,
        atlases: Sequence[Atlas],
        devices: Devices,
    ) -> "ShardedDiffuser":
        """Cut a planned diffuser over devices. Not for traced arrays.

        **Arguments:**

        - `whole`: planned for all splats, and for the tiles that any one device owns.
        - `parts`: the splats of each device.
        - `atlases`: the tiles of all devices.
        """
        tree, layers = whole.plans(kernels)
        real, rows = splats.count, parts[0].count
        origin = jnp.mean(splats.centers, axis=0)
        parent = np.zeros(rows * len(parts), np.int32)
        if tree.parents:
            places = np.asarray(tree.order)
            parent[places[places < real]] = np.asarray(tree.parents[0])[: len(places)][
                places < real
            ]
        orders, parents, singles = [], [], []
        for i, part in enumerate(parts):
            order = compact_order(np.asarray(part.centers, np.float64))
            room = blocks_of(rows) - rows
            parents.append(np.pad(parent[i * rows : (i + 1) * rows][order], (0, room)))
            orders.append(jnp.asarray(np.pad(order, (0, room), constant_values=rows), jnp.int32))
            singles.append(_single(part, orders[-1], origin))

        def roomy(layer: LayerPlan, variance, depth) -> LayerPlan:
            """Give a layer of single splats room for any device's at the pixels of all."""
            if not _of_single_splats(layer):
                return layer
            largest = float(variance) * whole.margin
            found = [
                whole.capacity_at(origin, each, None, largest, depth, layer.support, atlases)
                for each in singles
            ]
            return dataclasses.replace(layer, capacity=_largest(found))

        layers = tuple(
            roomy(*each) for each in zip(layers, kernels.variances, kernels.depths, strict=True)
        )
        above = ClusterTree(jnp.zeros(0, jnp.int32), tree.parents[1:], tree.counts[1:])
        whole = eqx.tree_at(lambda each: (each.tree, each.layers), whole, (above, layers))
        cells = tree.counts[0] if tree.counts else None
        return cls(
            whole,
            devices,
            jnp.concatenate(orders),
            jnp.asarray(np.concatenate(parents), jnp.int32),
            cells,
            real,
        )

    def planned(self, splats, kernels, interval, atlases):
        raise ValueError(
            "a ShardedDiffuser is planned for a mesh: give `mesh` to splatjax.plan, and settings "
            "without one"
        )

    def in_forward_mode(self):
        return eqx.tree_at(lambda each: each.whole, self, self.whole.in_forward_mode())

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        atlas: Atlas,
    ) -> Diffused:
        rows, devices = sources.areas.shape[0], self.devices
        tree, plans = self.whole.plans(kernels)
        real = devices.index() * rows + jnp.arange(rows, dtype=jnp.int32) < self.splats
        origin = stop_gradient(
            devices.total(jnp.sum(jnp.where(real[None], sources.centers, 0.0), axis=1))
            / self.splats
        )
        pixels = Pixels.of(points, covered, origin, atlas)
        everywhere = (
            pixels.of_all(devices) if any(_of_single_splats(layer) for layer in plans) else pixels
        )

        def within() -> tuple[list[Clusters], Pixels]:
            own = Clusters.of(
                _placed(
                    dataclasses.replace(sources, centers=sources.centers - origin[:, None]),
                    self.order,
                )
            )
            levels = [own]
            if self.cells is not None:
                levels += tree.above(own.merged(self.parents, self.cells, devices.total))
            return levels, pixels

        def together(gathering: Gathering, support: float, capacity: BinCapacity, pixels: Pixels):
            """Let the pixels of all devices gather from this device's splats, and add up for its
            own.
            """
            sums, needed = self.whole.at_pixels(
                gathering, support, capacity, everywhere, as_they_are
            )
            sums = jnp.pad(devices.own_share(sums[:-1]), ((0, 1), (0, 0), (0, 0)))
            return jax.vmap(gathering.finish)(sums, pixels.tiles), needed

        return self.whole.spread(within, kernels, sources.irradiance.shape[0], covered, together)


def _of_single_splats(layer: LayerPlan) -> bool:
    return layer.level == 0 and layer.capacity is not None


def _placed(sources: Sources, order: Int[Array, " places"]) -> Sources:
    return jax.tree.map(
        lambda values: values.at[..., order].get(mode="fill", fill_value=0), sources
    )


@eqx.filter_jit
def _single(splats: Splats, order, origin) -> Clusters:
    sources = Sources(
        splats.centers.T - origin[:, None], splats.normals.T, splats.areas, splats.areas[None]
    )
    return Clusters.of(_placed(sources, order))


def _largest(capacities: Sequence[BinCapacity]) -> BinCapacity:
    return BinCapacity(
        *(max(getattr(each, name) for each in capacities) for name in ("pairs", "blocks", "chunks"))
    )
