"""Light that enters the surface at every splat."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scene import StackedLights, sum_over_lights


def entering_irradiance(
    points: Float[Array, "splats 3"],
    normals: Float[Array, "splats 3"],
    groups: list[StackedLights],
    lit: list[Float[Array, "_lights splats"] | None],
    entering: Callable[[Float[Array, " splats"]], Float[Array, "#channels splats"]],
    channels: int,
) -> Float[Array, "channels splats"]:
    r"""Compute the irradiance that enters the surface, `sum_lights irradiance max(n . wi, 0) lit
    entering(n . wi)`.

    **Arguments:**

    - `lit`: for each group the share of each light that reaches each splat; `None` for lights that
      cast no shadows.
    - `entering`: the share that is left to diffuse, as a function of the cosine; one row for all
      channels, or one for each.

    **Returns:** linear in the lights. Differentiable in everything; the horizon is a kink.
    """

    def entering_of(light, share):
        wi, irradiance = light.incidence(points)
        cosine = jnp.maximum(jnp.sum(wi * normals, axis=-1), 0)
        received = cosine if share is None else cosine * share
        return irradiance.T * (received[None] * entering(cosine))

    return sum_over_lights(
        groups, lit, entering_of, jnp.zeros((channels, points.shape[0]), points.dtype)
    )
