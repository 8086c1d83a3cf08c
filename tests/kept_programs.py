"""A program that keeps what it makes in the folder it is given, as test_cache.py starts it several
times over; killed before its first file has a name, where it is told to be.
"""

import os
import signal
import sys

import jax.numpy as jnp

from splatjax.cache import keep, kept, kept_jit


@kept
def squares(count):
    print("made squares")
    return jnp.arange(count) ** 2


@kept_jit
def total(values):
    print("made total")
    return {"sum": jnp.sum(jnp.sin(values))}


keep(sys.argv[1])
killed = sys.argv[2:] == ["killed"]
if killed:
    os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
print(total(squares(1001 if killed else 1000))["sum"])  # another file, which is surely missing
