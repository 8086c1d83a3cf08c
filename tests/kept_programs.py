"""Two functions that are kept, and a list of what is made. As a program, both are called with the
folder it is given; killed before its first file has a name, at a given moment.
"""

import os
import signal
import sys

import jax
import jax.numpy as jnp

from splatjax.cache import keep, kept, kept_jit, reuse_capacity

made = []


@kept
def squares(values, power=2):
    made.append("squares")
    return {"squares": jnp.asarray(values) ** power}


@kept
def planned(least):
    return {"size": jnp.asarray(reuse_capacity("things", int(least), int(least)))}


@kept_jit
def total(tree):
    made.append("total")
    return {"sum": sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(tree))}


@kept_jit
def solved(matrix):
    made.append("solved")
    return jnp.linalg.solve(matrix, jnp.ones(len(matrix)))


if __name__ == "__main__":
    keep(sys.argv[1])
    killed = sys.argv[2:] == ["killed"]
    if killed:
        os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    values = squares(jnp.arange(1001.0 if killed else 1000.0))  # a file that is surely missing
    print(total(values)["sum"] + solved(2 * jnp.eye(2))[0], *made)
