"""How functions are computed: of many points a part at a time, of many steps as one program."""

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, PyTree

Result = TypeVar("Result", bound=PyTree)
Function = TypeVar("Function", bound=Callable)

AT_ONCE = 1 << 16


def in_parts(function: Callable[..., Result], *arrays: PyTree, at_once: int = AT_ONCE) -> Result:
    r"""Apply a function to parts of arrays, one after the other, and put the results together.

    What is no more than one part is done at once. Of more, what is computed on the way is never
    larger than a part, and for the derivative it is computed anew. What is found is kept: a
    compiler that fuses would otherwise compute it again wherever it is read, many times over.

    **Arguments:**

    - `function`: pointwise: element i of each result depends on element i of the arrays only, and
      on what it closes over.
    - `arrays`: trees of arrays, all of one length. Differentiable as the function is.
    - `at_once`: the length of a part.

    **Returns:** `function(*arrays)`.
    """
    count = jax.tree.leaves(arrays)[0].shape[0]
    fewest = -(-count // at_once)
    if fewest <= 1:
        return function(*arrays)
    parts = next(
        (parts for parts in range(fewest, 2 * fewest) if count % parts == 0), fewest
    )  # equal ones need no copy
    size = -(-count // parts)

    def cut(leaf):
        if parts * size > count:
            leaf = jnp.concatenate(
                [leaf, jnp.broadcast_to(leaf[-1:], (parts * size - count, *leaf.shape[1:]))]
            )
        return leaf.reshape(parts, size, *leaf.shape[1:])

    def one(part):
        return jax.tree.map(_planes, function(*jax.tree.map(_vectors, part, is_leaf=_is_planes)))

    found = jax.lax.map(jax.checkpoint(one), jax.tree.map(cut, jax.tree.map(_planes, arrays)))
    whole = jax.tree.map(lambda leaf: leaf.reshape(parts * size, *leaf.shape[2:])[:count], found)
    return jax.tree.map(_vectors, whole, is_leaf=_is_planes)


_LONGEST = 4  # of the vectors that are kept as planes


class _Planes(eqx.Module):
    """The numbers of vectors apart. A loop writes whole planes; numbers side by side the compiler
    would find one at a time.
    """

    planes: tuple[Array, ...]


def _is_planes(leaf) -> bool:
    return isinstance(leaf, _Planes)


def _planes(leaf: Array):
    if leaf.ndim != 2 or leaf.shape[1] > _LONGEST:
        return leaf
    return _Planes(tuple(plane[:, 0] for plane in jax.lax.split(leaf, [1] * leaf.shape[1], axis=1)))


def _vectors(leaf):
    return jnp.stack(leaf.planes, axis=1) if isinstance(leaf, _Planes) else leaf


def zeros_after(known: Array, shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    r"""Give zeros for a loop to write into, which are not made before something is known.

    A compiler makes constants as early as it likes and keeps one for all loops that begin with it,
    which copy it: without this the gradient of a frame holds an eighth more memory.

    **Arguments:**

    - `known`: any array that is not empty, of what the loop reads: the last that is found.
    - `shape`, `dtype`: of the zeros.
    """
    zero = jnp.minimum(
        (known.reshape(-1)[0] > 0).astype(jnp.int32), 0
    )  # the compiler does not know
    return jnp.full(shape, zero.astype(dtype))


def one_program(function: Function) -> Function:
    r"""Compile a function as one program where it is called by itself; within another program it is
    a part of that.

    Step by step each operation is a program of its own, for every shape, and takes as long to
    compile as a dozen together.

    **Arguments:**

    - `function`: pure; what is no array in its arguments tells programs apart.

    **Returns:** the same function, differentiable as it is.
    """
    compiled = eqx.filter_jit(function, inline=True)  # ty: ignore[no-matching-overload]

    @functools.wraps(function)
    def called(*arguments, **named):  # a function still, that classes bind as any other
        return compiled(*arguments, **named)

    return cast("Function", called)
