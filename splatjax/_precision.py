"""The precision of matrix products."""

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import jax

Function = TypeVar("Function", bound=Callable)


def full_precision(function: Function) -> Function:
    """Make a function multiply matrices in the precision of their elements. By default GPUs and
    TPUs round float32 factors to 11 or 8 bits.

    Its derivatives have that precision too, except those of a `jax.custom_vjp`, which are traced
    later.
    """

    @functools.wraps(function)
    def called(*arguments, **named):
        with jax.default_matmul_precision("highest"):
            return function(*arguments, **named)

    return cast("Function", called)
