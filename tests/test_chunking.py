"""Parts give what the whole gives, in value and in every derivative."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_close

from splatjax._chunking import map_chunks, needed_over_planned, zeros_after


def squares_and_lengths(scale, record):
    points, factors = record["points"], record["factors"]
    return {
        "scaled": scale * points * factors[:, None],
        "length": jnp.sqrt(jnp.sum(points * points, axis=1)) + scale,
    }


@pytest.mark.parametrize("at_once", [1, 3, 4, 11, 12])
def test_parts_give_what_the_whole_gives(at_once):
    keys = jax.random.split(jax.random.key(0), 2)
    record = {
        "points": jax.random.normal(keys[0], (11, 3)),
        "factors": jax.random.normal(keys[1], (11,)),
    }
    scale = jnp.asarray(1.5)

    def loss(scale, record, run):
        found = run(lambda part: squares_and_lengths(scale, part), record)
        return jnp.sum(jnp.sin(found["scaled"])) + jnp.sum(found["length"] ** 2), found

    parts, whole = partial(map_chunks, at_once=at_once), lambda function, tree: function(tree)
    derivative = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True), static_argnums=2)
    close = {"rtol": 1e-5, "atol": 1e-6}
    assert_close(derivative(scale, record, parts), derivative(scale, record, whole), **close)
    moved = scale, record
    along = jax.jit(
        lambda run: jax.jvp(lambda s, r: loss(s, r, run)[0], moved, moved)[1], static_argnums=0
    )
    np.testing.assert_allclose(along(parts), along(whole), **close)


def test_a_chunk_that_is_not_used_is_not_computed():
    numbers = jnp.asarray([0.0, 0.0, 4.0, 2.0, 0.0, 0.0])

    @jax.jit
    @jax.value_and_grad
    def total(scale):
        return jnp.sum(map_chunks(lambda part: scale / part, numbers, at_once=2, used=numbers > 0))

    value, derivative = total(2.0)
    assert value == 1.5
    assert derivative == 0.75


def test_zeros_wait_for_what_must_be_known_and_are_zeros_whatever_it_is():
    make = jax.jit(lambda known: zeros_after(known, (2, 3), jnp.float32))
    for known in (-1.0, 0.0, 5.0, np.nan, np.inf):
        found = make(jnp.full((4, 1), known))
        assert found.dtype == jnp.float32
        np.testing.assert_array_equal(found, np.zeros((2, 3)))
    assert "compare" in make.lower(jnp.zeros((4, 1))).compile().as_text()  # not made a constant of


@pytest.mark.parametrize("planned", [1, 3, 1000, 20_971_520, 2**31 - 2])
def test_one_more_than_planned_is_reported_however_much_was_planned(planned):
    ratio = jax.jit(lambda needed: needed_over_planned(needed, planned))
    assert float(ratio(jnp.int32(planned))) == 1
    assert float(ratio(jnp.int32(planned + 1))) > 1
    assert float(ratio(jnp.int32(0))) == 0
