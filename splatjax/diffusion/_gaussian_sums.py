"""Sums of Gaussians around blocks of sources at blocks of points, for all layers in one sweep, with
derivatives in forward and reverse mode that recompute the weights.

In every layer, a block of points has a list of the blocks of sources near it. Lists of similar
length are swept together, one per *lane*; in a step each lane processes the sources of the next row
of its list. The unit of length is the layer's standard deviation times the root of 2.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._chunking import zeros_after
from splatjax._precision import full_precision

from ._kernel import TruncatedGaussian
from ._neighbors import NeighborLists

LANES = 256  # lists that are swept together
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

    def planes(self) -> list[Float[Array, "blocks block"]]:
        """Compute the summed rows and moments."""
        centers = self.centers if self.moments else ()
        return [plane for row in self.rows for plane in (row, *(row * x for x in centers))]

    def rows_and_moments(self) -> Float[Array, "blocks sums block"]:
        return jnp.stack(self.planes(), axis=1)

    def contract(
        self, cotangents: Float[Array, "lanes sums points"]
    ) -> Float[Array, "lanes sources points"]:
        """Sum the products of `planes` with the cotangents of their sums.

        Written out, so that it is fused with the weights: a gradient takes a fifth less than with a
        matrix product.
        """
        both = zip(self.planes(), jnp.unstack(cotangents, axis=1), strict=True)
        terms = [plane[:, :, None] * cotangent[:, None] for plane, cotangent in both]
        return functools.reduce(jnp.add, terms)

    def gather(self, ids: Int[Array, "lanes width"]) -> "SourceTable":
        """Read the blocks of each lane, `[lanes, sources]`."""
        return jax.tree.map(
            lambda plane: plane.at[ids].get(mode="fill", fill_value=0).reshape(len(ids), -1), self
        )

    def scatter_add(
        self, ids: Int[Array, "lanes width"], cotangents: "SourceTable"
    ) -> "SourceTable":
        """Add to the sources of each lane: the transpose of `gather`."""
        return jax.tree.map(
            lambda plane, part: plane.at[ids].add(part.reshape(*ids.shape, -1), mode="drop"),
            self,
            cotangents,
        )


class _SweptLists(eqx.Module):
    """The lists that are swept, and the targets: the points at which sums are computed. Not
    differentiated.

    **Attributes:**

    - `kernels`: of each layer.
    - `lists`: without rows where no point is a target.
    - `order`: the lists, longest first.
    - `ranks`: the index of each point among the targets, in any order; for other points, distinct
      numbers from `count` on.
    - `count`: the number of targets. Static.
    """

    kernels: TruncatedGaussian
    lists: NeighborLists
    order: Int[Array, " lists"]
    ranks: Int[Array, "points_blocks block"]
    count: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        kernels: TruncatedGaussian,
        lists: NeighborLists,
        at: Int[Array, " targets"] | None,
        shape: tuple[int, int],
    ) -> "_SweptLists":
        """Choose the points `at` of all points, in blocks of a shape."""
        count, counts = shape[0] * shape[1], lists.counts
        ranks = jnp.arange(count, dtype=jnp.int32)
        if at is not None:
            count = len(at)
            ranks = (ranks + count).at[at].set(ranks[:count], mode="drop")
            is_target = jnp.any(ranks.reshape(shape) < count, axis=1)
            counts = jnp.where(is_target, counts.reshape(-1, len(is_target)), 0).reshape(-1)
        lists, order = NeighborLists(lists.rows, lists.first, counts), jnp.argsort(-counts)
        return cls(kernels, lists, order.astype(jnp.int32), ranks.reshape(shape), count)

    def each_round(
        self, function: Callable, points: Float[Array, "lists 3 block"], table: SourceTable, out
    ):
        """Apply `function(lists, points, places, each_row, out)` to all lists with a row, `LANES`
        of them at a time.

        Each lane has a list (distinct numbers beyond all lists for none), its points, and their
        places: indices of the layer, of all sums, and of the points among the sums.
        `each_row(add, carry)` applies `add(ids, sources, weights, minus_slopes, carry)` to row
        after row of the lists: the blocks of sources `[lanes, width]`, the sources, and of every
        source at every point `[lanes, sources, points]` the weight, and minus its derivative in the
        exponent.
        """
        lists, count = self.lists, len(self.order)
        lanes = min(LANES, count)
        order = jnp.append(self.order, jnp.arange(count, count + -count % lanes, dtype=jnp.int32))
        rounds = (jnp.sum(lists.counts > 0) + lanes - 1) // lanes

        def step(i, out):
            of_lanes = jax.lax.dynamic_slice_in_dim(order, i * lanes, lanes)
            first, counts = (
                per_list.at[of_lanes].get(mode="fill", fill_value=0)
                for per_list in (lists.first, lists.counts)
            )
            layer, block = jnp.divmod(of_lanes, len(self.ranks))
            kernels = jax.tree.map(lambda leaf: leaf.at[layer].get(mode="clip"), self.kernels)
            here = points.at[of_lanes].get(mode="fill", fill_value=FAR)
            places = layer[:, None], slice(None), self.ranks[block]

            def each_row(add: Callable, carry):
                def add_row(i, carry):
                    row = jnp.where(i < counts, first + i, len(lists.rows) - 1)
                    ids = lists.rows.at[row].get(mode="promise_in_bounds")
                    sources = table.gather(ids)
                    dx, dy, dz = (
                        here[:, axis, None] - center[:, :, None]
                        for axis, center in enumerate(sources.centers)
                    )
                    return add(ids, sources, *kernels(dx * dx + dy * dy + dz * dz), carry)

                return jax.lax.fori_loop(0, jnp.max(counts), add_row, carry)

            return function(of_lanes, here, places, each_row, out)

        return jax.lax.fori_loop(jnp.zeros_like(rounds), rounds, step, out)


def _forward(swept: _SweptLists, points, table: SourceTable):
    def add(_ids, sources: SourceTable, weights, _slopes, sums):
        return sums + jnp.einsum("lrs,lsp->lrp", sources.rows_and_moments(), weights)

    def sum_lanes(_lists, here, places, each_row, sums):
        zeros = jnp.zeros((len(here), count, points.shape[2]), points.dtype)
        lane_sums = each_row(add, zeros)
        # The derivative of repeated places would search for the value written last.
        places = sums.at[places]
        return places.set(jnp.swapaxes(lane_sums, 1, 2), mode="drop", unique_indices=True)

    count = len(table.rows) * (4 if table.moments else 1)
    shape = len(swept.kernels.largest), count, swept.count
    return swept.each_round(
        sum_lanes, points, table, zeros_after(table.rows[0], shape, points.dtype)
    )


@full_precision
def _backward(residuals, cotangents):
    """Compute the cotangents of points and sources from those of the sums.

    With `e = |x - p|^2` and `g = -dw / de * (rows_and_moments . cotangent)` for every pair of a
    point x and a source at p:

        d x = -2 sum_p g (x - p),    d p = 2 sum_x g (x - p)

    Both are moments of `g` over one side. Points and sources are relative to one of the sources, so
    that float32 does not cancel.
    """
    swept, points, table = residuals

    def add_cotangents(lists, here, places, each_row, carry):
        cotangent = cotangents.at[places].get(mode="fill", fill_value=0).swapaxes(1, 2)

        def add(ids, sources: SourceTable, weights, minus_slopes, carry):
            d_here, d_table = carry
            centers = jnp.stack(sources.centers, axis=1)
            origin = centers[:, :, :1]
            x, p = here - origin, centers - origin
            _, pull_rows = jax.vjp(SourceTable.rows_and_moments, sources)
            g = minus_slopes * sources.contract(cotangent)
            # Sum over the points: the cotangents of the sources.
            one_and_x = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1)
            over_points = jnp.einsum("lkp,lsp->lks", one_and_x, g)
            (d_sources,) = pull_rows(jnp.einsum("lrp,lsp->lrs", cotangent, weights))
            d_centers = jnp.unstack(2 * (over_points[:, 1:] - p * over_points[:, :1]), axis=1)
            d_centers = jax.tree.map(jnp.add, d_sources.centers, tuple(d_centers))
            d_sources = SourceTable(d_centers, d_sources.rows, table.moments)
            # Sum over the sources: the cotangents of the points.
            one_and_p = jnp.concatenate([jnp.ones_like(p[:, :1]), p], axis=1)
            over_sources = jnp.einsum("lks,lsp->lkp", one_and_p, g)
            d_here = d_here - 2 * (x * over_sources[:, :1] - over_sources[:, 1:])
            return d_here, d_table.scatter_add(ids, d_sources)

        d_points, d_table = carry
        d_here, d_table = each_row(add, (jnp.zeros_like(here), d_table))
        return d_points.at[lists].set(d_here, mode="drop"), d_table

    start = jax.tree.map(
        lambda array: zeros_after(cotangents, array.shape, array.dtype), (points, table)
    )
    return swept.each_round(add_cotangents, points, table, start)


_sums = jax.custom_vjp(_forward)
_sums.defvjp(
    lambda *arguments: (_forward(*arguments), arguments),
    lambda residuals, cotangents: (None, *_backward(residuals, cotangents)),
)


def gaussian_sums(
    points: Float[Array, "layers points_blocks 3 block"],
    table: SourceTable,
    lists: NeighborLists,
    kernels: TruncatedGaussian,
    at: Int[Array, " targets"] | None = None,
    forward_mode: bool = False,
) -> Float[Array, "layers sums targets"]:
    r"""Sum `rows_j exp(-|x - p_j|^2)` over the blocks of sources in the list of every point.

    **Arguments:**

    - `points`: `x`, in the unit of each layer. Differentiable.
    - `table`: `p_j` and `rows_j` of all layers. Differentiable.
    - `kernels`: of each layer; they replace `exp`. Terms beyond their rims vanish for any list.
    - `at`: the points of the sums, beyond all points for none; all for `None`.
    - `forward_mode`: differentiable only in forward mode, otherwise only in reverse mode. Static.
    """
    swept = _SweptLists.of(kernels, lists, at, (points.shape[1], points.shape[3]))
    # The loops have their own derivatives in forward mode.
    sums = _forward if forward_mode else _sums
    return sums(swept, points.reshape(-1, *points.shape[2:]), table)
