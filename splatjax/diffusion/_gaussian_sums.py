"""Sums of Gaussians around blocks of sources at blocks of points, for all layers in one sweep, with
derivatives in forward and reverse mode that recompute the weights.

In every layer, a block of points has a list of the blocks of sources near it. Lists of similar
length are swept together, one per *lane*; in a step each lane processes the sources of the next row
of its list. The unit of length is the layer's standard deviation times the root of 2.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._chunking import zeros_after
from splatjax._precision import full_precision

from ._kernel import TruncatedGaussian
from ._neighbors import Lanes, Lists

FAR = -1e6  # coordinate far from all points in every unit used, with a square finite in float32


class SourceTable(eqx.Module):
    """Sources in blocks, or of each lane of a sweep, as one plane per component: compiled code
    reads and multiplies planes faster than the rows of one array.

    **Attributes:**

    - `centers`: one plane per axis.
    - `rows`: to be summed.
    - `moments`: whether first moments are summed too: each row is then followed by itself times x,
      y and z. Static.
    """

    centers: tuple[Float[Array, "blocks block"], ...]
    rows: tuple[Float[Array, "blocks block"], ...]
    moments: bool = eqx.field(static=True)

    @property
    def count(self) -> int:
        """The number of sums."""
        return len(self.rows) * (4 if self.moments else 1)

    def rows_and_moments(self) -> Float[Array, "blocks sums block"]:
        """Compute the summed rows and moments."""
        centers = self.centers if self.moments else ()
        products = [(row, *(row * center for center in centers)) for row in self.rows]
        return jnp.stack([plane for row in products for plane in row], axis=1)

    def contract(
        self, cotangents: Float[Array, "lanes sums points"]
    ) -> Float[Array, "lanes sources points"]:
        """Sum the products of `rows_and_moments` with the cotangents of their sums.

        Written out, so that it is fused with the weights: a gradient takes a fifth less than with a
        matrix product.
        """
        of_sums = jnp.unstack(cotangents[:, :, None], axis=1)
        per_row = len(of_sums) // len(self.rows)
        terms = []
        for i, row in enumerate(self.rows):
            of_row, *of_moments = of_sums[i * per_row : (i + 1) * per_row]
            for center, of_moment in zip(self.centers, of_moments, strict=self.moments):
                of_row = of_row + center[..., None] * of_moment
            terms.append(row[..., None] * of_row)
        return functools.reduce(jnp.add, terms)

    def gather(self, ids: Int[Array, "lanes width"]) -> "SourceTable":
        """Read the blocks of each lane, `[lanes, sources]`."""

        def read(plane):
            return plane.at[ids].get(mode="fill", fill_value=0).reshape(len(ids), -1)

        return jax.tree.map(read, self)

    def scatter_add(
        self, ids: Int[Array, "lanes width"], cotangents: "SourceTable"
    ) -> "SourceTable":
        """Add to the sources of each lane: the transpose of `gather`."""

        def added(plane, part):
            return plane.at[ids].add(part.reshape(*ids.shape, -1), mode="drop")

        return jax.tree.map(added, self, cotangents)


class Targets(eqx.Module):
    """The points at which sums are computed.

    **Attributes:**

    - `ranks`: the index of each point among the targets, in any order; for other points, distinct
      numbers from `count` on.
    - `count`: the number of targets. Static.
    """

    ranks: Int[Array, "points_blocks block"]
    count: int = eqx.field(static=True)

    @classmethod
    def of(cls, at: Int[Array, " targets"] | None, blocks: int, block: int) -> "Targets":
        """Choose the points `at` of all points in blocks, beyond all for none; all for `None`."""
        every = jnp.arange(blocks * block, dtype=jnp.int32)
        if at is None:
            return cls(every.reshape(blocks, block), blocks * block)
        ranks = (every + len(at)).at[at].set(every[: len(at)], mode="drop")
        return cls(ranks.reshape(blocks, block), len(at))

    def _at(self, lanes: Lanes) -> tuple:
        """Index the layer, all sums, and the points of each lane."""
        layer, block = jnp.divmod(lanes.lists, len(self.ranks))
        return layer[:, None], slice(None), self.ranks[block]

    def write(
        self,
        sums: Float[Array, "layers sums targets"],
        lanes: Lanes,
        values: Float[Array, "lanes sums block"],
    ) -> Float[Array, "layers sums targets"]:
        # No place is written twice; else the derivative searches for the last of several values.
        places = sums.at[self._at(lanes)]
        return places.set(jnp.swapaxes(values, 1, 2), mode="drop", unique_indices=True)

    def read(
        self, sums: Float[Array, "layers sums targets"], lanes: Lanes
    ) -> Float[Array, "lanes sums block"]:
        """Read the values that `write` wrote; 0 for other points."""
        return jnp.swapaxes(sums.at[self._at(lanes)].get(mode="fill", fill_value=0), 1, 2)


class _Sweep(eqx.Module):
    """The common state of all sweeps. Not differentiated."""

    kernels: TruncatedGaussian
    lists: Lists
    targets: Targets

    def sweep(self, sweep, points, out):
        """Apply `sweep(lanes, kernels of the lanes, points of the lanes, out)` to all lists."""

        def with_points(lanes: Lanes, out):
            layer = lanes.lists // len(self.targets.ranks)
            kernels = jax.tree.map(lambda leaf: leaf.at[layer].get(mode="clip"), self.kernels)
            return sweep(lanes, kernels, lanes.read(points, FAR), out)

        return self.lists.sweep(with_points, out)

    def sums(self, points, table: SourceTable, add):
        """Sum over all sources of the points: `add(lanes, ids, kernels, points, sums)`."""
        block = points.shape[2]

        def sweep(lanes: Lanes, kernels, x, out):
            start = jnp.zeros((len(x), table.count, block), x.dtype)
            lane_sums = lanes.each_row(
                self.lists, lambda ids, sums: add(lanes, ids, kernels, x, sums), start
            )
            return self.targets.write(out, lanes, lane_sums)

        layers = len(self.kernels.largest)
        out = zeros_after(table.rows[0], (layers, table.count, self.targets.count), points.dtype)
        return self.sweep(sweep, points, out)


def _weigh(kernels: TruncatedGaussian, points, sources: SourceTable):
    """Compute weights `[lanes, sources, points]`, minus their derivatives in the exponent, and
    offsets.
    """
    dx, dy, dz = (
        points[:, axis, None] - center[:, :, None] for axis, center in enumerate(sources.centers)
    )
    return *kernels(dx * dx + dy * dy + dz * dz), (dx, dy, dz)


def _forward(sweeps: _Sweep, points, table: SourceTable):
    def add(lanes, ids, kernels, x, sums):
        sources = table.gather(ids)
        weights, *_ = _weigh(kernels, x, sources)
        return sums + jnp.einsum("lrs,lsp->lrp", sources.rows_and_moments(), weights)

    return sweeps.sums(points, table, add)


@full_precision
def _backward(residuals, cotangents):
    """Compute the cotangents of points and sources from those of the sums.

    With `e = |x - p|^2` and `g = -dw / de * (rows_and_moments . cotangent)` for every pair of a
    point x and a source at p:

        d x = -2 sum_p g (x - p),    d p = 2 sum_x g (x - p)

    Both are moments of `g` over one side. Points and sources are relative to one of the sources, so
    that float32 does not cancel.
    """
    sweeps, points, table = residuals

    def sweep(lanes: Lanes, kernels, lane_points, carry):
        d_points, d_table = carry
        cotangent = sweeps.targets.read(cotangents, lanes)

        def add(ids, carry):
            d_here, d_table = carry
            sources = table.gather(ids)
            weights, minus_slopes, _ = _weigh(kernels, lane_points, sources)
            centers = jnp.stack(sources.centers, axis=1)
            origin = centers[:, :, :1]
            x, p = lane_points - origin, centers - origin
            _, pull_rows = jax.vjp(SourceTable.rows_and_moments, sources)
            g = minus_slopes * sources.contract(cotangent)
            # Sum over the points: the cotangents of the sources.
            one_and_x = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1)
            over_points = jnp.einsum("lkp,lsp->lks", one_and_x, g)
            d_rows = jnp.einsum("lrp,lsp->lrs", cotangent, weights)
            d_centers = 2 * (over_points[:, 1:] - p * over_points[:, :1])
            (d_sources,) = pull_rows(d_rows)
            d_centers = jax.tree.map(
                jnp.add, d_sources.centers, tuple(jnp.unstack(d_centers, axis=1))
            )
            d_sources = SourceTable(d_centers, d_sources.rows, table.moments)
            # Sum over the sources: the cotangents of the points.
            one_and_p = jnp.concatenate([jnp.ones_like(p[:, :1]), p], axis=1)
            over_sources = jnp.einsum("lks,lsp->lkp", one_and_p, g)
            d_here = d_here - 2 * (x * over_sources[:, :1] - over_sources[:, 1:])
            return d_here, d_table.scatter_add(ids, d_sources)

        d_here, d_table = lanes.each_row(sweeps.lists, add, (jnp.zeros_like(lane_points), d_table))
        return lanes.write(d_points, d_here), d_table

    start = jax.tree.map(
        lambda array: zeros_after(cotangents, array.shape, array.dtype), (points, table)
    )
    return sweeps.sweep(sweep, points, start)


_sums = jax.custom_vjp(_forward)
_sums.defvjp(
    lambda *arguments: (_forward(*arguments), arguments),
    lambda residuals, cotangents: (None, *_backward(residuals, cotangents)),
)


def gaussian_sums(
    points: Float[Array, "layers points_blocks 3 block"],
    table: SourceTable,
    lists: Lists,
    kernels: TruncatedGaussian,
    targets: Targets,
    forward_mode: bool = False,
) -> Float[Array, "layers sums targets"]:
    r"""Sum `rows_j exp(-|x - p_j|^2)` over the blocks of sources in the list of every point.

    **Arguments:**

    - `points`: `x`, in the unit of each layer. Differentiable.
    - `table`: `p_j` and `rows_j` of all layers. Differentiable.
    - `kernels`: of each layer; they replace `exp`. Terms beyond their rims vanish for any list.
    - `targets`: the points of the sums.
    - `forward_mode`: differentiable only in forward mode, otherwise only in reverse mode. Static.
    """
    sweeps = _Sweep(kernels, lists, targets)
    # The loops have their own derivatives in forward mode.
    sums = _forward if forward_mode else _sums
    return sums(sweeps, points.reshape(-1, *points.shape[2:]), table)
