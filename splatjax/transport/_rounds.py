"""Simulation of photons in lanes: a lane starts the next photon when its photon has ended.
Counter-based uniform random numbers.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from splatjax._chunking import jit_unless_traced
from splatjax._records import is_traced

from ._results import Sum, photon_moments
from ._walk import (
    IDLE,
    INSIDE,
    AbstractIncidence,
    LayeredMedia,
    PathWeights,
    Photons,
    fly,
    weigh,
)

# Flights between two checks for finished photons.
_FLIGHTS = 4

# Rounds of one compiled call, about a second, after which progress is reported.
_ROUNDS = 256

# Rounds between two checks for the end of the walk.
_UNWATCHED = 8

# Russian roulette: the weight below which a photon is terminated, and the probability that it
# survives with a larger weight.
_LEAST, _SURVIVING = 1e-4, 0.1


class Walk(eqx.Module):
    r"""The constants of a walk, in free paths.

    **Attributes:**

    - `media`: media of the channels that share the walk. Differentiable in `sigma_a` and `sigma_s`.
    - `edges`: edges of the rings of each channel.
    - `key`: the random key of this walk.
    - `photons`, `flights`: number of photons, and most flights per photon. They are traced, so that
      other numbers need no recompilation.
    """

    media: LayeredMedia
    edges: Float[Array, "channels edges"]
    key: Key[Array, ""]
    incidence: AbstractIncidence
    photons: Int[Array, ""]
    flights: Int[Array, ""]
    lanes: int = eqx.field(static=True)


class _State(eqx.Module):
    photons: Photons
    weights: PathWeights
    slopes: PathWeights
    tally: Sum
    started: Int[Array, ""]
    round: Int[Array, ""]

    @jit_unless_traced
    def unfinished(self, walk: Walk) -> Bool[Array, ""]:
        return (self.started < walk.photons) | jnp.any(self.photons.place == INSIDE)


def finish(
    walk: Walk, with_slopes: bool, progress: Callable[[int], None] | None
) -> Float[Array, "channels places moments"]:
    """Simulate all photons, and compute means over them. Under `jit` this is one loop; otherwise
    several calls, between which the number of finished photons is reported.

    **Returns:** the means of `photon_moments`; `with_slopes`, also their derivatives with respect
    to the absorption of each layer, then the scattering of each layer.
    """
    state = _start(walk, with_slopes)
    if is_traced(walk):
        state = jax.lax.while_loop(
            lambda state: state.unfinished(walk), lambda state: _round(walk, state), state
        )
    else:
        while bool(state.unfinished(walk)):
            state = _advance(walk, state)
            if progress is not None:
                under_way = int(np.sum(np.asarray(state.photons.place) == INSIDE))
                progress(int(state.started) - under_way)
    photons = walk.photons.astype(walk.edges.dtype)
    return state.tally.high / photons + state.tally.low / photons


@eqx.filter_jit
def _start(walk: Walk, with_slopes: bool) -> _State:
    dtype, (layers, channels) = walk.edges.dtype, walk.media.sigma_a.shape
    parameters, rings = 2 * layers * with_slopes, walk.edges.shape[1] - 1
    zero, number = jnp.zeros(walk.lanes, dtype), jnp.zeros(walk.lanes, jnp.int32)
    photons = Photons(zero, zero, zero, (zero, zero, zero + 1), zero, number, number + IDLE, number)
    weights = PathWeights(
        jnp.zeros((channels, walk.lanes), dtype), jnp.zeros((layers, channels, walk.lanes), dtype)
    )
    slopes = jax.tree.map(lambda leaf: jnp.zeros((parameters, *leaf.shape), dtype), weights)
    nothing = jnp.zeros((channels, 2 * rings + 3 + layers, 2 + parameters), dtype)
    state = _State(photons, weights, slopes, Sum(nothing, nothing), number[0], number[0])
    return _launch(walk, state, photons.place == IDLE)


@eqx.filter_jit
def _advance(walk: Walk, state: _State) -> _State:
    last = state.round + _ROUNDS
    return jax.lax.while_loop(
        lambda state: (state.round < last) & state.unfinished(walk),
        lambda state: jax.lax.fori_loop(0, _UNWATCHED, lambda _, state: _round(walk, state), state),
        state,
    )


def _round(walk: Walk, state: _State) -> _State:
    """Move photons by a few flights, count those that have ended, and start others in their
    lanes.
    """
    draws = state.round * (_FLIGHTS + 2)

    def path(sigma_a, sigma_s, weights):
        def flight(number, carry):
            photons, weights = carry
            xi = uniforms(walk.key, draws + number, walk.lanes, weights.carried.dtype)
            moved, *flown = fly(walk.media, photons, xi)
            return moved, weigh(sigma_a, sigma_s, weights, photons.layer, *flown)

        photons, weights = jax.lax.fori_loop(0, _FLIGHTS, flight, (state.photons, weights))
        return weights, photons

    start, slopes = (walk.media.sigma_a, walk.media.sigma_s, state.weights), state.slopes
    parameters = len(slopes.carried)
    if parameters:
        layers, channels = walk.media.sigma_a.shape
        steps = jnp.eye(parameters, dtype=walk.edges.dtype).reshape(parameters, 2, layers, 1)
        steps = jnp.broadcast_to(steps, (parameters, 2, layers, channels))

        def push(step, slopes):
            return jax.jvp(path, start, (*step, slopes), has_aux=True)

        weights, slopes, photons = jax.vmap(push, out_axes=(None, 0, None))(steps, slopes)
    else:
        weights, photons = path(*start)

    inside = photons.place == INSIDE
    faint = inside & (jnp.max(weights.carried, axis=0) < _LEAST)
    chance = uniforms(walk.key, draws + _FLIGHTS, walk.lanes, walk.edges.dtype)[0]
    dropped = faint & (chance > _SURVIVING)
    boost = jnp.where(faint & ~dropped, 1 / _SURVIVING, jnp.ones_like(chance))
    weights, slopes = (
        PathWeights(part.carried * jnp.broadcast_to(boost, part.carried.shape), part.absorbed)
        for part in (weights, slopes)
    )
    done = (
        ((photons.place != INSIDE) & (photons.place != IDLE))
        | dropped
        | (inside & (photons.flights >= walk.flights))
    )
    tally = state.tally.plus(photon_moments(photons, weights, slopes, done, dropped, walk.edges))
    after = _State(photons, weights, slopes, tally, state.started, state.round + 1)
    return _launch(walk, after, done | (photons.place == IDLE))


def _launch(walk: Walk, state: _State, free: Bool[Array, " photons"]) -> _State:
    """Start the remaining photons in free lanes."""
    dtype = walk.edges.dtype
    turn = jnp.cumsum(free.astype(jnp.int32))
    begins = free & (state.started + turn <= walk.photons)
    xi = uniforms(walk.key, state.round * (_FLIGHTS + 2) + _FLIGHTS + 1, walk.lanes, dtype)
    spread = evenly(walk.key, state.started + turn, dtype)
    direction, weight = walk.incidence.enter(spread, xi[1], walk.media.eta[:2, 0])

    zero, number = jnp.zeros(walk.lanes, dtype), jnp.zeros(walk.lanes, jnp.int32)
    fresh = Photons(
        zero,
        zero,
        zero,
        direction,
        to_scatter=-jnp.log(xi[2]),
        layer=number,
        place=jnp.where(begins, INSIDE, IDLE),
        flights=number,
    )
    photons = jax.tree.map(lambda new, old: jnp.where(free, new, old), fresh, state.photons)
    weights, slopes = (
        jax.tree.map(lambda leaf: jnp.where(jnp.broadcast_to(free, leaf.shape), 0.0, leaf), part)
        for part in (state.weights, state.slopes)
    )
    carried = weights.carried + jnp.where(begins, weight, zero)[None]
    return _State(
        photons,
        PathWeights(carried, weights.absorbed),
        slopes,
        state.tally,
        started=state.started + jnp.sum(begins, dtype=jnp.int32),
        round=state.round,
    )


# 2^32 over the golden ratio.
_GOLDEN = 0x9E3779B9


def uniforms(
    key: Key[Array, ""], number: Int[Array, ""], lanes: int, dtype
) -> Float[Array, "four lanes"]:
    """Draw four independent numbers in (0, 1] for each lane, multiples of 2^-24, by Threefry 2x32
    with 20 rounds. `number` is the counter.

    `jax.random` gives the same numbers, but on a CPU it lowers each round of the cipher to a loop
    over memory, which takes longer than all other parts of a flight.

    **Source:** Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3".
    """
    words = jax.random.key_data(key).reshape(-1).astype(jnp.uint32)
    # The lane is the lower word of the counter; each of the two streams draws two numbers per lane.
    higher = 2 * number.astype(jnp.uint32) + jnp.arange(2, dtype=jnp.uint32)
    pairs = [
        jax.lax.rng_bit_generator(
            jnp.stack([words[0], words[-1], jnp.uint32(0), word]),
            (2, lanes),
            algorithm=jax.lax.RandomAlgorithm.RNG_THREE_FRY,
        )[1]
        for word in higher
    ]
    return ((jnp.concatenate(pairs) >> 8) + jnp.uint32(1)).astype(dtype) * 2.0**-24


def evenly(key: Key[Array, ""], number: Int[Array, " lanes"], dtype) -> Float[Array, " lanes"]:
    """Compute a low-discrepancy sequence in (0, 1]: the Weyl sequence of the golden ratio with a
    random start.

    The mean of a smooth function over the sequence is nearly exact.
    """
    word = number.astype(jnp.uint32) * jnp.uint32(_GOLDEN) + jax.random.bits(key, (), jnp.uint32)
    return ((word >> 8) + jnp.uint32(1)).astype(dtype) * 2.0**-24
