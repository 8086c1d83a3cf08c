"""Sums of Gaussians around blocks of sources at blocks of points, with a derivative that recomputes
the weights.

Every block of points has a list of the blocks of sources near it. Some blocks of points, one per
*lane*, are swept together; in a *step* each lane meets the next few blocks of its list. Tables hold
centers and the summed rows, one block of sources after the other. The unit of length is the
standard deviation times the root of 2.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import zeros_after

from ._kernel import TruncatedGaussian

FAR = -1e6  # mm from anything, yet with a square that float32 holds


class Steps(eqx.Module):
    """Which blocks of sources the blocks of points meet. Not differentiated.

    **Attributes:**

    - `ids`: blocks of sources; the number of blocks, whose block is empty, in an empty slot.
    - `begins`, `ends`: the steps of each sweep.
    - `order`: the block of points of each lane, sweep after sweep.
    """

    ids: Int[Array, "steps lanes slots"]
    begins: Int[Array, " sweeps"]
    ends: Int[Array, " sweeps"]
    order: Int[Array, " points_blocks"]

    def lanes(self, sweep: Int[Array, ""]) -> Int[Array, " lanes"]:
        """Return the blocks of points of one sweep."""
        lanes = self.ids.shape[1]
        return lax.dynamic_slice_in_dim(self.order, sweep * lanes, lanes)

    def only(self, wanted: Bool[Array, " points"], block: int) -> "Steps":
        """Leave out the sweeps none of whose points is wanted."""
        blocks = jnp.any(wanted.reshape(-1, block), axis=1)
        blocks = jnp.pad(blocks, (0, self.order.shape[0] - blocks.shape[0]))
        sweeps = jnp.any(blocks[self.order].reshape(len(self.begins), -1), axis=1)
        return Steps(self.ids, self.begins, jnp.where(sweeps, self.ends, self.begins), self.order)


def identity(
    sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
) -> Float[Array, "rows points"]:
    """Return the sums themselves."""
    return sums


class _Rule(eqx.Module):
    """What all sweeps share. Static."""

    kernel: TruncatedGaussian
    finish: Callable = eqx.field(static=True)

    def finished(self, sums: Float[Array, "lanes rows points"], points):
        return jax.vmap(self.finish)(sums, points)

    def weights(self, points, sources):
        """Compute weights `[lanes, sources, points]`, minus their derivatives in the exponent,
        and offsets.
        """
        dx, dy, dz = (points[:, axis, None] - sources[:, axis, :, None] for axis in range(3))
        squared = dx * dx + dy * dy + dz * dz
        return *self.kernel(squared), (dx, dy, dz)

    def sums(self, steps: Steps, sweep, here, table):
        """Sum over all that a sweep's points meet."""

        def add(step, sums):
            sources, _ = _met(table, steps, step)
            weights, *_ = self.weights(here, sources)
            return sums + jnp.einsum("lrs,lsp->lrp", sources[:, 3:], weights)

        start = jnp.zeros((here.shape[0], table.shape[1] - 3, here.shape[2]), here.dtype)
        return lax.fori_loop(steps.begins[sweep], steps.ends[sweep], add, start)


def points_blocks(
    points: Float[Array, "3 points"], steps: Steps, block: int
) -> Float[Array, "points_blocks 3 block"]:
    """Cut points into blocks; those that fill the last sweep lie far from everything."""
    blocks = points.reshape(3, -1, block).transpose(1, 0, 2)
    spare = steps.order.shape[0] - blocks.shape[0]
    return jnp.pad(blocks, ((0, spare), (0, 0), (0, 0)), constant_values=FAR)


def source_table(
    centers: Float[Array, "3 sources"],
    rows: Float[Array, "rows sources"],
    block: int,
) -> Float[Array, "blocks_and_one columns block"]:
    """Lay out sources, `block` of them to a block; the last block is empty."""
    columns = jnp.concatenate([centers, rows])
    return jnp.pad(
        columns.reshape(columns.shape[0], -1, block).transpose(1, 0, 2), ((0, 1), (0, 0), (0, 0))
    )


def _met(table, steps: Steps, step):
    """Read the sources that each lane meets in a step, `[lanes, columns, sources]`, and their
    blocks.
    """
    ids = lax.dynamic_index_in_dim(steps.ids, step, 0, keepdims=False)
    sources = jnp.moveaxis(table.at[ids].get(mode="promise_in_bounds"), 1, 2)
    return sources.reshape(ids.shape[0], table.shape[1], -1), ids


def _swept(steps: Steps, sweep: Callable, out):
    """Let every sweep write the values of its points."""

    def write(i, out):
        lanes = steps.lanes(i)
        return out.at[lanes].set(sweep(i, lanes), mode="promise_in_bounds")

    return lax.fori_loop(0, steps.begins.shape[0], write, out)


def _forward(rule: _Rule, steps: Steps, points, table):
    def sweep(i, lanes):
        here = points.at[lanes].get(mode="promise_in_bounds")
        return rule.finished(rule.sums(steps, i, here, table), here)

    return _swept(steps, sweep, _empty(rule, points, table))


def _empty(rule: _Rule, points, table):
    sums = jax.ShapeDtypeStruct(
        (points.shape[0], table.shape[1] - 3, points.shape[2]), points.dtype
    )
    values = jax.eval_shape(rule.finished, sums, points)
    return zeros_after(table, values.shape, values.dtype)


def _derivative(rule: _Rule, steps: Steps, points, table, d_points, d_table):
    """Compute the values and their derivative along a direction; weights are evaluated once."""
    rows = table.shape[1] - 3

    def sweep(i, lanes):
        here, d_here = (each.at[lanes].get(mode="promise_in_bounds") for each in (points, d_points))

        def add(step, sums):
            (sources, _), (moved, _) = _met(table, steps, step), _met(d_table, steps, step)
            weights, falls, offsets = rule.weights(here, sources)
            nearer = sum(
                offset * (moved[:, axis, :, None] - d_here[:, axis, None])
                for axis, offset in enumerate(offsets)
            )
            d_weights = 2 * falls * nearer
            both = jnp.concatenate([sources[:, 3:], moved[:, 3:]], axis=1)
            both = jnp.einsum("lrs,lsp->lrp", both, weights)
            moving = jnp.einsum("lrs,lsp->lrp", sources[:, 3:], d_weights)
            return sums + both.at[:, rows:].add(moving)

        start = jnp.zeros((here.shape[0], 2 * rows, here.shape[2]), here.dtype)
        sums = lax.fori_loop(steps.begins[i], steps.ends[i], add, start)
        along = sums[:, rows:], d_here
        values, slopes = jax.jvp(rule.finished, (sums[:, :rows], here), along)
        return jnp.concatenate([values, slopes], axis=1)

    empty = _empty(rule, points, table)
    out = _swept(steps, sweep, jnp.concatenate([empty, empty], axis=1))
    return out[:, : empty.shape[1]], out[:, empty.shape[1] :]


def _backward(rule: _Rule, steps: Steps, points, table, sums, cotangents):
    def sweep(i, carry):
        d_points, d_table = carry
        lanes = steps.lanes(i)
        here, total, cotangent = (
            each.at[lanes].get(mode="promise_in_bounds") for each in (points, sums, cotangents)
        )
        _, pull = jax.vjp(rule.finished, total, here)
        cotangent, d_finish = pull(cotangent)

        def add(step, carry):
            d_here, d_table = carry
            sources, ids = _met(table, steps, step)
            weights, falls, _ = rule.weights(here, sources)
            # The factor of an exponent's cotangent is a polynomial in point and source, seen from
            # one of the sources: its moments over the points and over the sources suffice.
            origin = sources[:, :3, :1]
            x, y = here - origin, sources[:, :3] - origin
            # Written out, so that it is fused with the weights: half the time of a matrix product.
            pairs = zip(
                jnp.unstack(sources[:, 3:], axis=1), jnp.unstack(cotangent, axis=1), strict=True
            )
            pulls = falls * sum(row[:, :, None] * each[:, None] for row, each in pairs)
            of_points = jnp.concatenate([jnp.ones_like(x[:, :1]), x], axis=1)
            moments = jnp.einsum("lkp,lsp->lks", of_points, pulls)
            d_rows = jnp.einsum("lrp,lsp->lrs", cotangent, weights)
            d_centers = 2 * (moments[:, 1:] - y * moments[:, :1])
            of_sources = jnp.concatenate([jnp.ones_like(y[:, :1]), y], axis=1)
            toward = jnp.einsum("lks,lsp->lkp", of_sources, pulls)
            part = jnp.concatenate([d_centers, d_rows], axis=1)
            part = part.reshape(part.shape[0], part.shape[1], ids.shape[1], -1)
            d_table = d_table.at[ids].add(jnp.moveaxis(part, 2, 1), mode="promise_in_bounds")
            return d_here - 2 * (x * toward[:, :1] - toward[:, 1:]), d_table

        d_here, d_table = lax.fori_loop(steps.begins[i], steps.ends[i], add, (d_finish, d_table))
        return d_points.at[lanes].set(d_here, mode="promise_in_bounds"), d_table

    start = tuple(zeros_after(cotangents, each.shape, each.dtype) for each in (points, table))
    return lax.fori_loop(0, steps.begins.shape[0], sweep, start)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sums(rule: _Rule, steps: Steps, points, table):
    return _forward(rule, steps, points, table)


def _sums_fwd(rule: _Rule, steps: Steps, points, table):
    sums = _forward(_Rule(rule.kernel, identity), steps, points, table)
    return rule.finished(sums, points), (steps, points, table, sums)


def _sums_bwd(rule: _Rule, residuals, cotangents):
    return (None, *_backward(rule, *residuals, cotangents))


_sums.defvjp(_sums_fwd, _sums_bwd)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sums_forward(rule: _Rule, steps: Steps, points, table):
    return _forward(rule, steps, points, table)


@_sums_forward.defjvp
def _sums_jvp(rule: _Rule, primals, tangents):
    return _derivative(rule, *primals, *tangents[1:])


def gaussian_sums(
    points: Float[Array, "points_blocks 3 points"],
    table: Float[Array, "blocks_and_one columns block"],
    steps: Steps,
    kernel: TruncatedGaussian,
    finish: Callable[
        [Float[Array, "rows points"], Float[Array, "3 points"]], Float[Array, "values points"]
    ],
) -> Float[Array, "points_blocks values points"]:
    r"""Sum `rows_j exp(-|x - p_j|^2)` over the blocks of sources that every point meets.

    **Arguments:**

    - `points`: `x`, from `points_blocks`. Differentiable.
    - `table`: from `source_table`: `p_j` and `rows_j`. Differentiable.
    - `kernel`: stands for `exp`; terms beyond its rim vanish, whatever the lists hold. Static.
    - `finish`: computes values from sums and points. Static.

    **Returns:** the values; 0 for blocks of points that no sweep visits.
    """
    return _sums(_Rule(kernel, finish), steps, points, table)


def gaussian_sums_forward(
    points: Float[Array, "points_blocks 3 points"],
    table: Float[Array, "blocks_and_one columns block"],
    steps: Steps,
    kernel: TruncatedGaussian,
    finish: Callable[
        [Float[Array, "rows points"], Float[Array, "3 points"]], Float[Array, "values points"]
    ],
) -> Float[Array, "points_blocks values points"]:
    """Sum as `gaussian_sums` does, with forward mode instead of reverse mode."""
    return _sums_forward(_Rule(kernel, finish), steps, points, table)
