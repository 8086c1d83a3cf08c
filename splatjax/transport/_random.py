"""Uniform random numbers by counting, in one pass.

`jax.random` gives the same numbers, but on a CPU it lowers each round of the cipher to a loop over
memory, which takes longer than all the physics of a flight.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA
_ROUNDS = 20
_GOLDEN = 0x9E3779B9
"""2^32 over the golden ratio."""


def uniforms(
    key: Key[Array, ""], number: Int[Array, ""], lanes: int, dtype
) -> Float[Array, "four lanes"]:
    """Draw four independent numbers in (0, 1] for each lane, steps of 2^-24: the `number`-th of a
    key.
    """
    words = jax.random.key_data(key).reshape(-1).astype(jnp.uint32)
    lane = jnp.arange(lanes, dtype=jnp.uint32)
    count = jnp.broadcast_to(2 * number.astype(jnp.uint32), (lanes,))
    pairs = [threefry(words[0], words[-1], lane, count + jnp.uint32(half)) for half in (0, 1)]
    return jnp.stack(
        [((word >> 8) + jnp.uint32(1)).astype(dtype) * 2.0**-24 for pair in pairs for word in pair]
    )


def evenly(key: Key[Array, ""], number: Int[Array, " lanes"], dtype) -> Float[Array, " lanes"]:
    """Draw numbers in (0, 1] that fill it evenly as `number` counts: Weyl's sequence of the golden
    ratio, from a random start.

    Means over a smooth function of one of them are nearly exact.
    """
    start = jax.random.bits(key, (), jnp.uint32)
    word = number.astype(jnp.uint32) * jnp.uint32(_GOLDEN) + start
    return ((word >> 8) + jnp.uint32(1)).astype(dtype) * 2.0**-24


def threefry(
    first: UInt32[Array, ""],
    second: UInt32[Array, ""],
    x: UInt32[Array, " lanes"],
    y: UInt32[Array, " lanes"],
) -> tuple[UInt32[Array, " lanes"], UInt32[Array, " lanes"]]:
    """Encipher pairs of words: Threefry 2x32 with 20 rounds.

    **Source:** Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3".
    """
    keys = (first, second, first ^ second ^ jnp.uint32(_PARITY))
    x, y = x + keys[0], y + keys[1]
    for number in range(_ROUNDS):
        distance = _ROTATIONS[number // 4 % 2][number % 4]
        x = x + y
        y = ((y << distance) | (y >> (32 - distance))) ^ x
        if number % 4 == 3:
            group = number // 4 + 1
            x, y = x + keys[group % 3], y + keys[(group + 1) % 3] + jnp.uint32(group)
    return x, y
