"""Functions of one point, applied to many points a part at a time."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, PyTree

Result = TypeVar("Result", bound=PyTree)

AT_ONCE = 1 << 16


def in_parts(function: Callable[..., Result], *arrays: PyTree, at_once: int = AT_ONCE) -> Result:
    r"""Apply a function to parts of arrays, one after the other, and put the results together.

    What is no more than one part is done at once. Of more, what is computed on the way is never larger than a part, and for the
    derivative it is computed anew. What is found is kept: a compiler that fuses would otherwise compute it again wherever it is
    read, many times over.

    **Arguments:**

    - `function`: pointwise: element i of each result depends on element i of the arrays only, and on what it closes over.
    - `arrays`: trees of arrays, all of one length. Differentiable as the function is.
    - `at_once`: the length of a part.

    **Returns:** `function(*arrays)`.
    """
    count = jax.tree.leaves(arrays)[0].shape[0]
    fewest = -(-count // at_once)
    if fewest <= 1:
        return function(*arrays)
    parts = next((parts for parts in range(fewest, 2 * fewest) if count % parts == 0), fewest)  # equal ones need no copy
    size = -(-count // parts)

    def cut(leaf):
        if parts * size > count:
            leaf = jnp.concatenate([leaf, jnp.broadcast_to(leaf[-1:], (parts * size - count, *leaf.shape[1:]))])
        return leaf.reshape(parts, size, *leaf.shape[1:])

    found = jax.lax.map(jax.checkpoint(lambda part: function(*part)), jax.tree.map(cut, arrays))
    return jax.tree.map(lambda leaf: leaf.reshape(parts * size, *leaf.shape[2:])[:count], found)


def zeros_after(known: Array, shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    r"""Give zeros for a loop to write into, which are not made before something is known.

    A compiler makes constants as early as it likes and keeps one for all loops that begin with it, which copy it: without this
    the gradient of a frame holds an eighth more memory.

    **Arguments:**

    - `known`: any array that is not empty, of what the loop reads: the last that is found.
    - `shape`, `dtype`: of the zeros.
    """
    zero = jnp.minimum((known.reshape(-1)[0] > 0).astype(jnp.int32), 0)  # the compiler does not know
    return jnp.full(shape, zero.astype(dtype))
