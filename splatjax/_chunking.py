"""Evaluation of pointwise functions in chunks, compilation of functions as one program, and planned
capacities of arrays with static shapes.
"""

import functools
from collections.abc import Callable, Hashable
from typing import TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, DTypeLike, Float, Int, PyTree, Shaped

from splatjax._precision import Function, full_precision
from splatjax.cache import reuse_capacity

Result = TypeVar("Result", bound=PyTree)

AT_ONCE = 1 << 16
_LEAST_SPARE = 1.1
_LONGEST_DOUBLED = 1 << 19  # both methods take equally long at this length


def map_chunks(
    function: Callable[..., Result],
    *arrays: PyTree,
    at_once: int = AT_ONCE,
    used: Bool[Array, " length"] | None = None,
) -> Result:
    r"""Apply a pointwise function to chunks of arrays, one after the other, and join the results.

    Arrays of at most one chunk are computed directly. For longer arrays, no intermediate is larger
    than a chunk, and the derivative recomputes the intermediates. The results are materialized;
    otherwise a fusing compiler would recompute them for every use.

    **Arguments:**

    - `function`: pointwise: element i of each result depends only on element i of the arrays and on
      variables that the function closes over.
    - `arrays`: trees of arrays of equal length. Differentiable as `function` is.
    - `at_once`: the largest length of a chunk.
    - `used`: the elements whose results are used; all for `None`. If there are several chunks, a
      chunk without used elements is not computed, and its results are 0.

    **Returns:** `function(*arrays)`.
    """
    length = jax.tree.leaves(arrays)[0].shape[0]
    fewest = -(-length // at_once)
    if fewest <= 1:
        return function(*arrays)
    chunks = next(
        (count for count in range(fewest, 2 * fewest) if length % count == 0), fewest
    )  # equal chunks need no copy
    size = -(-length // chunks)

    def split(leaf):
        if chunks * size > length:
            leaf = jnp.concatenate(
                [leaf, jnp.broadcast_to(leaf[-1:], (chunks * size - length, *leaf.shape[1:]))]
            )
        return leaf.reshape(chunks, size, *leaf.shape[1:])

    def compute(chunk):
        return jax.tree.map(_planes, function(*_vectors(chunk)))

    def compute_used(chunk):
        arrays, used = chunk
        if used is None:
            return compute(arrays)
        result = jax.eval_shape(compute, arrays)
        return jax.lax.cond(
            jnp.any(used),
            compute,
            lambda _: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), result),
            arrays,
        )

    results = jax.lax.map(
        jax.checkpoint(compute_used), jax.tree.map(split, (jax.tree.map(_planes, arrays), used))
    )
    return _vectors(
        jax.tree.map(lambda leaf: leaf.reshape(chunks * size, *leaf.shape[2:])[:length], results)
    )


_LONGEST = 4  # components of the vectors that are stored as planes


class _Planes(eqx.Module):
    """The components of vectors as separate arrays: loops read and write whole planes, but would
    fetch interleaved components one at a time.
    """

    planes: tuple[Array, ...]


def _planes(leaf: Array):
    if leaf.ndim != 2 or leaf.shape[1] > _LONGEST:
        return leaf
    return _Planes(tuple(plane[:, 0] for plane in jax.lax.split(leaf, [1] * leaf.shape[1], axis=1)))


def _vectors(tree: PyTree) -> PyTree:
    return jax.tree.map(
        lambda leaf: jnp.stack(leaf.planes, axis=1) if isinstance(leaf, _Planes) else leaf,
        tree,
        is_leaf=lambda leaf: isinstance(leaf, _Planes),
    )


def take_rows(
    array: Shaped[Array, "points ..."], chosen: Int[Array, " chosen"]
) -> Shaped[Array, "chosen ..."]:
    """Take points along the first axis at ascending indices; indices past the end give 0."""
    if len(array) == 0:
        return jnp.zeros((len(chosen), *array.shape[1:]), array.dtype)
    return array.at[chosen].get(mode="fill", fill_value=0, indices_are_sorted=True)


def take_points(
    rows: Shaped[Array, "*rows points"], chosen: Int[Array, " chosen"] | None
) -> Shaped[Array, "*rows chosen"]:
    """Take points along the last axis at ascending indices; `None` takes all."""
    if chosen is None:
        return rows
    if rows.size == 0:
        return jnp.zeros((*rows.shape[:-1], len(chosen)), rows.dtype)
    # Row by row: the derivative then concatenates planes once, whereas that of slices adds arrays.
    count = rows.shape[-1]
    planes = jax.lax.split(rows.reshape(-1, count), [1] * (rows.size // count))
    taken = jnp.stack([take_rows(plane[0], chosen) for plane in planes])
    return taken.reshape(*rows.shape[:-1], len(chosen))


def stack_rows(rows: PyTree[Float[Array, "... points"]]) -> Float[Array, "all points"]:
    """Stack the rows of a tree of arrays."""
    return jnp.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in jax.tree.leaves(rows)])


def split_rows(stacked: Float[Array, "all points"], like: PyTree) -> PyTree:
    """Undo `stack_rows`, for a tree of arrays that differs from `like` only in its last axis."""
    leaves, structure = jax.tree.flatten(like)
    parts = jax.lax.split(stacked, [leaf.size // leaf.shape[-1] for leaf in leaves], axis=0)
    return structure.unflatten(
        part.reshape(*leaf.shape[:-1], stacked.shape[1])
        for part, leaf in zip(parts, leaves, strict=True)
    )


def running(
    combine: Callable[[Array, Array], Array], values: Int[Array, "*rows n"]
) -> Int[Array, "*rows n"]:
    """Compute running sums, or running maxima of non-negative numbers, along the last axis.

    XLA's own cumulative sum has a dozen kernels and takes three times as long to compile. It needs
    fewer additions, so it is used for long arrays.
    """
    length = values.shape[-1]
    if length > _LONGEST_DOUBLED and combine is jnp.add:
        return jnp.cumsum(values, axis=-1)
    padding = [(0, 0)] * (values.ndim - 1) + [(length, 0)]

    def double(step, values):  # from the last 2^step of each to the last 2^(step + 1)
        padded = jnp.pad(values, padding)
        return combine(
            values, jax.lax.dynamic_slice_in_dim(padded, length - (1 << step), length, axis=-1)
        )

    return jax.lax.fori_loop(jnp.int32(0), jnp.int32((length - 1).bit_length()), double, values)


def divided(numbers: Int[Array, "*shape"], by: int) -> tuple[Int[Array, "*shape"], ...]:
    """Compute quotients and remainders of non-negative numbers. `divmod` has ten more instructions,
    for negative numbers.
    """
    quotients = jax.lax.div(numbers, jnp.full_like(numbers, by))
    return quotients, numbers - quotients * by


def list_chosen(chosen: Bool[Array, " all"], capacity: int) -> Int[Array, " capacity"]:
    """List the ascending indices of chosen elements, up to a capacity. Unused entries are
    `len(chosen)`.
    """
    places = jnp.where(chosen, running(jnp.add, chosen.astype(jnp.int32)) - 1, capacity)
    every = jnp.arange(len(chosen), dtype=jnp.int32)
    return jnp.full(capacity, len(chosen), jnp.int32).at[places].set(every, mode="drop")


def rounded_up(count: int, step: int, per_octave: int = 8) -> int:
    """Round up to a multiple of `step` and of `per_octave` (a power of 2) steps per octave, so that
    nearby counts share a program.
    """
    grain = max(1 << max(count.bit_length() - per_octave.bit_length(), 0), step)
    return -(-count // grain) * grain


def with_spare(
    kind: Hashable,
    count: int,
    step: int,
    per_octave: int = 8,
    spare: float = 1.03,
    cheap: int = 0,
    most: float = 1.25,
) -> int:
    """Plan the capacity of a kind of array for a count: `spare` times the count, at least one more,
    rounded up. An earlier capacity with that margin, or with 10%, is reused.

    **Arguments:**

    - `cheap`: a capacity that costs hardly any time. Up to it, twice the count is planned and every
      earlier capacity is reused, so that other bodies in small pictures share a program.
    - `most`: the largest earlier capacity that is reused, over the one planned.
    """
    planned = max(int(count * spare), min(2 * count, cheap)) + 1
    capacity = rounded_up(planned, step, per_octave)
    least = int(count * min(spare, _LEAST_SPARE)) + 1
    most = max(1 + 1 / per_octave, most, cheap / capacity)
    return reuse_capacity((kind, step, per_octave, spare), least, capacity, most)


def needed_over_planned(needed: Int[Array, ""], planned: int) -> Float[Array, ""]:
    """Divide the needed by the planned capacity. The ratio exceeds 1 if and only if more is needed,
    even above 16.7 million, where a plain quotient would round to 1.
    """
    ratio = needed.astype(jnp.float32) / planned
    return jnp.where(needed > planned, jnp.maximum(ratio, 1 + jnp.finfo(ratio.dtype).eps), ratio)


@jax.custom_jvp
def materialized(tree: PyTree[Array]) -> PyTree[Array]:
    """Return arrays unchanged, computed only once: the compiler cannot fuse their computation into
    their uses, where it might be repeated, done one number at a time, or run on one thread.
    """
    never = _hidden_zero(tree)
    return jax.lax.fori_loop(0, never, lambda _, kept: jax.tree.map(jnp.flip, kept), tree)


@materialized.defjvp
def _materialized_jvp(primals, tangents):
    return materialized(*primals), tangents[0]


def zeros_after(inputs: PyTree[Array], shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    r"""Return zeros for a loop to write into, allocated only after other arrays are computed.

    A compiler allocates constants early and keeps one copy for all loops that begin with them; each
    loop then copies it. Without this dependency a frame takes a third more memory, and its gradient
    an eighth more.

    **Arguments:**

    - `inputs`: the inputs of the loop that are computed last, with at least one element in total.
    - `shape`, `dtype`: shape and type of the zeros.
    """
    return jnp.full(shape, _hidden_zero(inputs).astype(dtype))


def _hidden_zero(arrays: PyTree[Array]) -> Int[Array, ""]:
    """Return a 0 that the compiler cannot infer."""
    first = [leaf.reshape(-1)[0] > 0 for leaf in jax.tree.leaves(arrays) if leaf.size]
    return jnp.minimum(jnp.stack(first).astype(jnp.int32).sum(), 0)


def jit_unless_traced(function: Function) -> Function:
    r"""Compile a function as one program when it is called eagerly; inline it within another
    program.

    Executed eagerly, each operation would be a program of its own for every shape, and would take
    as long to compile as a dozen fused ones.

    **Arguments:**

    - `function`: pure. Arguments that are not arrays are static.

    **Returns:** the same function, differentiable as before.
    """
    compiled = eqx.filter_jit(function, inline=True)  # ty: ignore[no-matching-overload]

    @functools.wraps(function)
    @full_precision
    def called(*arguments, **named):  # a plain function, so that classes bind it as a method
        return compiled(*arguments, **named)

    return cast("Function", called)
