"""Conversion of spectral profiles to colors."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._records import numbers, record
from splatjax.gaussians import AbstractProfile


@record
class Projected(AbstractProfile):
    r"""A spectral profile, converted to red, green and blue by a matrix.

    Converting the profile instead of the picture is exact only if light and albedo are the same at
    all wavelengths and the kernel of pass 4 has gain 1 (`diffusion.PlainMean`, or flat surfaces).
    With `EscapeNormalization` the gain on a curved body depends on the wavelength; render the
    wavelengths and convert the picture instead.

    **Attributes:** (differentiable)

    - `profile`: a profile with one channel per row of the matrix.
    - `matrix`: as `io.spectrum_to_rgb` computes it.

    **Raises:** `ValueError` for a matrix whose number of rows is not the number of channels.
    """

    profile: AbstractProfile
    matrix: Float[Array, "wavelengths colors"] = eqx.field(converter=numbers)

    singular: ClassVar[bool] = True

    def __check_init__(self):
        rows, channels = len(self.matrix), len(jax.eval_shape(self.profile.length_scale))
        if rows != channels:
            raise ValueError(
                f"Projected.matrix has {rows} rows, and Projected.profile has {channels} channels; "
                "give one row per channel"
            )

    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return jnp.dot(self.profile(r), self.matrix)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.profile.total_reflectance() @ self.matrix

    def length_scale(self) -> Float[Array, " channels"]:
        share = jnp.abs(self.matrix)
        return self.profile.length_scale() @ (share / jnp.sum(share, axis=0, keepdims=True))
