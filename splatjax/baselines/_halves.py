"""Figure 8: one half of a picture by one method, the other by another, and where they differ."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class HalfAndHalf(eqx.Module):
    """Three pictures beside each other."""

    halves: Float[Array, "height width channels"]
    """The left of the first and the right of the second."""
    difference: Float[Array, "height width channels"]
    """Second less first, around a middle gray of 1/2."""


def half_and_half(
    left: Float[Array, "height width channels"],
    right: Float[Array, "height width channels"],
    gain: float = 4.0,
) -> HalfAndHalf:
    r"""Put two pictures of the same view together, as Figure 8 does.

    **Arguments:**

    - `left`, `right`: radiance.
    - `gain`: by how much differences are enlarged.

    **Returns:** the halves, in radiance, and the difference of the whole pictures, to be shown as
    it is.

    **Source:** Kim et al. 2010, Figure 8.
    """
    middle = left.shape[1] // 2
    halves = jnp.concatenate([left[:, :middle], right[:, middle:]], axis=1)
    return HalfAndHalf(halves, jnp.clip(0.5 + gain * (right - left), 0.0, 1.0))
