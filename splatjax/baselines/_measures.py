"""What is compared between pictures by different methods."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import shading as _shading
from splatjax.scene import Frame


def exitance(frame: Frame) -> Float[Array, "height width channels"]:
    """Give the radiant exitance of a picture before the albedo colors what leaves; of a surface
    that reflects nothing itself.

    What is left is how light has spread: the weighted layers `L_k`; 0 where there is nothing.
    """
    is_covered = frame.coverage > 0
    share = jnp.where(is_covered, frame.coverage, 1.0)[..., None]
    spread = jnp.pi * frame.diffuse / (share * _shading.albedo_root(frame.albedo / share))
    return jnp.where(is_covered[..., None], spread, 0.0)
