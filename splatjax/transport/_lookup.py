"""Tables of a few layers, read by many photons."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def of_layer(
    table: Float[Array, "layers *channels"], layer: Int[Array, " photons"]
) -> Float[Array, "*channels photons"]:
    """Give each photon its layer's entry: by choices, which vectorize, and not by a gather, which
    does not.
    """
    shape = (*table.shape[1:], *layer.shape)
    entry = jnp.broadcast_to(table[0][..., None], shape)
    for number in range(1, table.shape[0]):
        here = jnp.broadcast_to(layer == number, shape)
        entry = jnp.where(here, jnp.broadcast_to(table[number][..., None], shape), entry)
    return entry
