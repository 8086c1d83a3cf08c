"""Sums of Gaussians around blocks of sources at blocks of points, with derivatives in forward and
reverse mode that recompute the weights.

Every block of points has a list of the blocks of sources near it. Blocks of points with lists of
about one length are swept together, one per *lane*; in a step each lane meets the sources of the
next row of its list. The unit of length is the standard deviation times the root of 2.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._chunking import zeros_after

from ._kernel import TruncatedGaussian
from ._neighbors import Lists, PointBlocks

FAR = -1e6  # from anything, in any unit in use here, yet with a square that float32 holds


class SourceTable(eqx.Module):
    """Sources in blocks; or those that each lane of a sweep meets.

    **Attributes:**

    - `centers`: apart by axis, which is quicker.
    - `rows`: to be summed.
    - `moments`: whether the sums also hold first moments. They are then
      `[rows, rows * x, rows * y, rows * z]`, each in the order of `rows`. Static.
    """

    centers: tuple[Float[Array, "blocks block"], ...]
    rows: Float[Array, "blocks rows block"]
    moments: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        centers: Float[Array, "3 sources"],
        rows: Float[Array, "rows sources"],
        block: int,
        moments: bool,
    ) -> "SourceTable":
        """Lay out sources, `block` of them to a block."""
        rows = rows.reshape(len(rows), -1, block).transpose(1, 0, 2)
        return cls(tuple(centers.reshape(3, -1, block)), rows, moments)

    @property
    def count(self) -> int:
        """The number of sums."""
        return self.rows.shape[1] * (4 if self.moments else 1)

    def rows_and_moments(self) -> Float[Array, "blocks sums block"]:
        """Compute what is summed."""
        if not self.moments:
            return self.rows
        moments = [self.rows * center[:, None] for center in self.centers]
        return jnp.concatenate([self.rows, *moments], axis=1)

    def contract(
        self, cotangents: Float[Array, "lanes sums points"]
    ) -> Float[Array, "lanes sources points"]:
        """Sum the products of `rows_and_moments` with the cotangents of their sums.

        Written out, so that it is fused with the weights: half the time of a matrix product.
        """
        of_sums, rows = jnp.unstack(cotangents[:, :, None], axis=1), jnp.unstack(self.rows, axis=1)
        terms = []
        for i, row in enumerate(rows):
            of_row, *of_moments = of_sums[i :: len(rows)]
            for center, of_moment in zip(self.centers, of_moments, strict=self.moments):
                of_row = of_row + center[..., None] * of_moment
            terms.append(row[..., None] * of_row)
        return functools.reduce(jnp.add, terms)

    def gather(self, ids: Int[Array, "lanes width"]) -> "SourceTable":
        """Read the blocks that each lane meets, `[lanes, sources]` and `[lanes, rows, sources]`."""
        x, y, z, rows = (
            each.at[ids].get(mode="fill", fill_value=0) for each in (*self.centers, self.rows)
        )
        rows = jnp.moveaxis(rows, 1, 2).reshape(len(ids), rows.shape[2], -1)
        centers = tuple(each.reshape(len(ids), -1) for each in (x, y, z))
        return SourceTable(centers, rows, self.moments)

    def scatter_add(
        self, ids: Int[Array, "lanes width"], cotangents: "SourceTable"
    ) -> "SourceTable":
        """Add to the sources that each lane meets: the transpose of `gather`."""

        def added(table, part):
            part = part.reshape(*part.shape[:-1], ids.shape[1], -1)
            return table.at[ids].add(jnp.moveaxis(part, -2, 1), mode="drop")

        return jax.tree.map(added, self, cotangents)


def identity(
    sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
) -> Float[Array, "rows points"]:
    """Return the sums themselves."""
    return sums


class _Rule(eqx.Module):
    """What all sweeps share."""

    kernel: TruncatedGaussian
    finish: Callable = eqx.field(static=True)

    def finished(self, sums: Float[Array, "lanes rows points"], points):
        return jax.vmap(self.finish)(sums, points)

    def weights(self, points, sources: SourceTable):
        """Compute weights `[lanes, sources, points]`, minus their derivatives in the exponent,
        and offsets.
        """
        dx, dy, dz = (
            points[:, axis, None] - center[:, :, None]
            for axis, center in enumerate(sources.centers)
        )
        squared = dx * dx + dy * dy + dz * dz
        return *self.kernel(squared), (dx, dy, dz)

    def sums(self, lists: Lists, lanes: PointBlocks, here, table):
        """Sum over all that a sweep's points meet."""

        def add(ids, sums):
            sources = table.gather(ids)
            weights, *_ = self.weights(here, sources)
            return sums + jnp.einsum("lrs,lsp->lrp", sources.rows_and_moments(), weights)

        start = jnp.zeros((here.shape[0], table.count, here.shape[2]), here.dtype)
        return lanes.each_row(lists, add, start)


def _forward(rule: _Rule, lists: Lists, points, table):
    def sweep(lanes, out):
        here = lanes.read(points, FAR)
        return lanes.write(out, rule.finished(rule.sums(lists, lanes, here, table), here))

    return lists.sweep(sweep, _empty(rule, points, table))


def _empty(rule: _Rule, points, table):
    shape = points.shape[0], table.count, points.shape[2]
    values = jax.eval_shape(rule.finished, jax.ShapeDtypeStruct(shape, points.dtype), points)
    return zeros_after(table.rows, values.shape, values.dtype)


def _derivative(residuals, moved):
    """Compute the derivative of the values along a direction."""
    (rule, lists, points, table, sums), (d_points, d_table) = residuals, moved

    def sweep(lanes, out):
        here, d_here = lanes.read(points, FAR), lanes.read(d_points)

        def add(ids, d_sums):
            sources, d_sources = table.gather(ids), d_table.gather(ids)
            weights, minus_slopes, offsets = rule.weights(here, sources)
            minus_half_change = sum(
                offset * (center[:, :, None] - d_here[:, axis, None])
                for axis, (offset, center) in enumerate(
                    zip(offsets, d_sources.centers, strict=True)
                )
            )
            rows, d_rows = jax.jvp(SourceTable.rows_and_moments, (sources,), (d_sources,))
            d_sums += jnp.einsum("lrs,lsp->lrp", d_rows, weights)
            return d_sums + jnp.einsum("lrs,lsp->lrp", rows, 2 * minus_slopes * minus_half_change)

        total = lanes.read(sums)
        d_total = lanes.each_row(lists, add, jnp.zeros_like(total))
        return lanes.write(out, jax.jvp(rule.finished, (total, here), (d_total, d_here))[1])

    return lists.sweep(sweep, _empty(rule, points, table))


def _backward(residuals, cotangents):
    """Compute the transpose of `_derivative`.

    With `e = |x - p|^2` and `g = -dw / de * (rows_and_moments . cotangent)` for every pair of a
    point x and a source at p:

        d x = -2 sum_p g (x - p),    d p = 2 sum_x g (x - p)

    Both are moments of `g` over one side. Points and sources are counted from one of the sources,
    so that float32 does not cancel.
    """
    rule, lists, points, table, sums = residuals

    def sweep(lanes, carry):
        d_points, d_table = carry
        here, total, cotangent = lanes.read(points, FAR), lanes.read(sums), lanes.read(cotangents)
        _, pull = jax.vjp(rule.finished, total, here)
        cotangent, d_finish = pull(cotangent)

        def add(ids, carry):
            d_here, d_table = carry
            sources = table.gather(ids)
            weights, minus_slopes, _ = rule.weights(here, sources)
            centers = jnp.stack(sources.centers, axis=1)
            origin = centers[:, :, :1]
            x, p = here - origin, centers - origin
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

        d_here, d_table = lanes.each_row(lists, add, (d_finish, d_table))
        return lanes.write(d_points, d_here), d_table

    start = jax.tree.map(
        lambda each: zeros_after(cotangents, each.shape, each.dtype), (points, table)
    )
    return lists.sweep(sweep, start)


@jax.custom_jvp
def _sums(rule: _Rule, lists: Lists, points, table):
    return _forward(rule, lists, points, table)


@_sums.defjvp
def _sums_jvp(primals, tangents):
    rule, _, points, _ = primals
    sums = _forward(_Rule(rule.kernel, identity), *primals[1:])
    # Linear in the direction, with a transpose of its own: forward and reverse mode.
    given = (*primals, sums)
    moved = jax.custom_derivatives.linear_call(_derivative, _backward, given, tangents[2:])
    return rule.finished(sums, points), moved


def gaussian_sums(
    points: Float[Array, "points_blocks 3 points"],
    table: SourceTable,
    lists: Lists,
    kernel: TruncatedGaussian,
    finish: Callable[
        [Float[Array, "rows points"], Float[Array, "3 points"]], Float[Array, "values points"]
    ],
) -> Float[Array, "points_blocks values points"]:
    r"""Sum `rows_j exp(-|x - p_j|^2)` over the blocks of sources that every point meets.

    **Arguments:**

    - `points`: `x`. Differentiable.
    - `table`: `p_j` and `rows_j`. Differentiable.
    - `kernel`: stands for `exp`; terms beyond its rim vanish, whatever the lists hold.
    - `finish`: computes values from sums and points. Static.

    **Returns:** the values; 0 for blocks of points without a list.
    """
    return _sums(_Rule(kernel, finish), lists, points, table)
