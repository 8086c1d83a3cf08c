"""Photons by the lane: each lane takes the next photon when it is done with one."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Key

from splatjax._chunking import jit_unless_traced

from ._incidence import AbstractIncidence
from ._phase import AbstractPhaseFunction
from ._random import evenly, uniforms
from ._stack import Stack
from ._tally import Tally
from ._walk import IDLE, INSIDE, Optics, PathWeights, Photons, fly, weigh

_MOST_LANES, _LEAST_LANES, _PHOTONS_A_LANE = 16384, 1024, 8
"""Photons on their way at once: their state stays in the cache of a core or two, and few lanes wait
for the last photon.
"""

_FLIGHTS = 4
"""Flights between two looks at who is done."""

_ROUNDS = 256
"""Rounds of one compiled call: a second or so, after which progress is told."""

_UNWATCHED = 8
"""Rounds between two looks at whether all are done."""

_LEAST, _SURVIVING = 1e-4, 0.1
"""A photon that carries less than this is given up, except for this share, which carries more
instead (Russian roulette).
"""


class Walk(eqx.Module):
    r"""The constants of a walk.

    **Attributes:**

    - `optics`: of the channels that walk along; `slopes` are its derivatives in each parameter.
    - `edges`: of the rings, in free paths of the stack, for each channel.
    - `photons`: how many, `flights`: at most so many each.
    """

    stack: Stack
    phase: AbstractPhaseFunction
    incidence: AbstractIncidence
    optics: Optics
    slopes: Optics
    edges: Float[Array, "channels edges"]
    photons: Int[Array, ""]
    flights: Int[Array, ""]
    key: Key[Array, ""]
    lanes: int = eqx.field(static=True)


def lanes_for(photons: int) -> int:
    """Choose how many photons to have on their way at once."""
    return min(_MOST_LANES, max(_LEAST_LANES, 1 << (photons // _PHOTONS_A_LANE).bit_length()))


class _State(eqx.Module):
    photons: Photons
    weights: PathWeights
    slopes: PathWeights
    tally: Tally
    started: Int[Array, ""]
    round: Int[Array, ""]

    @jit_unless_traced
    def unfinished(self, walk: Walk) -> Bool[Array, ""]:
        return (self.started < walk.photons) | jnp.any(self.photons.place == INSIDE)


def finish(walk: Walk, progress: Callable[[int, int], None]) -> Tally:
    """Walk all photons to their end. Under `jit` in one loop, else call by call, reporting progress
    in between.
    """
    state = _start(walk)
    if isinstance(state.started, Tracer):
        return jax.lax.while_loop(
            lambda state: state.unfinished(walk), lambda state: _round(walk, state), state
        ).tally
    while bool(state.unfinished(walk)):
        state = _advance(walk, state)
        under_way = int(np.sum(np.asarray(state.photons.place) == INSIDE))
        progress(int(state.started) - under_way, int(walk.photons))
    return state.tally


@eqx.filter_jit
def _start(walk: Walk) -> _State:
    dtype, (layers, channels) = walk.edges.dtype, walk.optics.absorption.shape
    parameters, rings = walk.slopes.absorption.shape[0], walk.edges.shape[1] - 1
    zero, number = jnp.zeros(walk.lanes, dtype), jnp.zeros(walk.lanes, jnp.int32)
    photons = Photons(zero, zero, zero, (zero, zero, zero + 1), zero, number, number + IDLE, number)
    weights = PathWeights(
        jnp.zeros((channels, walk.lanes), dtype), jnp.zeros((layers, channels, walk.lanes), dtype)
    )
    slopes = jax.tree.map(lambda leaf: jnp.zeros((parameters, *leaf.shape), dtype), weights)
    tally = Tally.empty(rings, layers, channels, parameters, dtype)
    state = _State(photons, weights, slopes, tally, number[0], number[0])
    return _launch(walk, state, photons.place == IDLE)


@eqx.filter_jit
def _advance(walk: Walk, state: _State) -> _State:
    last = state.round + _ROUNDS

    def goes_on(state):
        return (state.round < last) & state.unfinished(walk)

    def some(state):
        return jax.lax.fori_loop(0, _UNWATCHED, lambda _, state: _round(walk, state), state)

    return jax.lax.while_loop(goes_on, some, state)


def _round(walk: Walk, state: _State) -> _State:
    """Fly, find who is done, count them, and start others in their places."""
    draws = state.round * (_FLIGHTS + 2)

    def path(optics, weights):
        def flight(number, carry):
            photons, weights = carry
            xi = uniforms(walk.key, draws + number, walk.lanes, weights.carried.dtype)
            photons, flown = fly(walk.stack, walk.phase, photons, xi)
            return photons, weigh(optics, weights, flown)

        photons, weights = jax.lax.fori_loop(0, _FLIGHTS, flight, (state.photons, weights))
        return weights, photons

    if walk.slopes.absorption.shape[0]:

        def push(optics, weights):
            return jax.jvp(path, (walk.optics, state.weights), (optics, weights), has_aux=True)

        weights, slopes, photons = jax.vmap(push, out_axes=(None, 0, None))(
            walk.slopes, state.slopes
        )
    else:
        (weights, photons), slopes = path(walk.optics, state.weights), state.slopes

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
    tally = state.tally.plus(photons, weights, slopes, done, dropped, walk.edges)
    after = _State(photons, weights, slopes, tally, state.started, state.round + 1)
    return _launch(walk, after, done | (photons.place == IDLE))


def _launch(walk: Walk, state: _State, free: Bool[Array, " photons"]) -> _State:
    """Start photons in lanes that are free, as long as there are any left to start."""
    dtype = walk.edges.dtype
    turn = jnp.cumsum(free.astype(jnp.int32))
    begins = free & (state.started + turn <= walk.photons)
    xi = uniforms(walk.key, state.round * (_FLIGHTS + 2) + _FLIGHTS + 1, walk.lanes, dtype)
    spread = evenly(walk.key, state.started + turn, dtype)
    direction, weight = walk.incidence.enter(spread, xi[1], walk.stack.eta[:2])

    zero, number = jnp.zeros(walk.lanes, dtype), jnp.zeros(walk.lanes, jnp.int32)
    fresh = Photons(zero, zero, zero, direction, -jnp.log(xi[2]), number, number + INSIDE, number)
    photons = jax.tree.map(lambda new, old: jnp.where(begins, new, old), fresh, state.photons)
    idle = jnp.where(free & ~begins, IDLE, photons.place)
    photons = eqx.tree_at(lambda photons: photons.place, photons, idle)
    weights, slopes = (
        jax.tree.map(lambda leaf: jnp.where(jnp.broadcast_to(free, leaf.shape), 0.0, leaf), part)
        for part in (state.weights, state.slopes)
    )
    started_weight = jnp.broadcast_to(jnp.where(begins, weight, zero), weights.carried.shape)
    weights = PathWeights(weights.carried + started_weight, weights.absorbed)
    started = state.started + jnp.sum(begins, dtype=jnp.int32)
    return _State(photons, weights, slopes, state.tally, started, state.round)
