"""The precision of products of matrices."""

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import jax

Function = TypeVar("Function", bound=Callable)


def full_precision(function: Function) -> Function:
    """Multiply matrices in the precision of their elements: by default GPUs and TPUs round factors
    in float32 to 11 or 8 bits.

    A derivative has the precision of the function, except that of a `jax.custom_vjp`, which is
    traced later.
    """

    @functools.wraps(function)
    def called(*arguments, **named):
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **named)

    return cast("Function", called)
