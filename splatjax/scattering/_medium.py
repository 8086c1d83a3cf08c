"""Optical coefficients: homogeneous media, and the layers of a stack."""

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax._records import check_values, numbers, record, valid


@record
class Medium(eqx.Module):
    r"""A homogeneous medium under the diffusion approximation.

    **Attributes:** (any number of channels; all differentiable)

    - `sigma_a`: absorption coefficient, 1/mm, at least 0.
    - `sigma_s_prime`: reduced scattering coefficient, 1/mm, positive.
    - `eta`: index of refraction relative to air.

    **Raises:** `ValueError` for a value out of these ranges. Under `jit` values are unknown, and
    not checked.
    """

    sigma_a: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("at least 0 (1/mm)", lambda x: x >= 0)
    )
    sigma_s_prime: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("positive (1/mm)", lambda x: x > 0)
    )
    eta: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("positive", lambda x: x > 0)
    )

    @property
    def channels(self) -> int:
        return self.sigma_a.shape[-1]

    @property
    def sigma_t_prime(self) -> Float[Array, " channels"]:
        """Reduced extinction coefficient, 1/mm."""
        return self.sigma_a + self.sigma_s_prime

    @property
    def albedo_prime(self) -> Float[Array, " channels"]:
        """Reduced single-scattering albedo."""
        return self.sigma_s_prime / self.sigma_t_prime

    @property
    def squared_sigma_tr(self) -> Float[Array, " channels"]:
        """Square of the effective transport coefficient, `3 sigma_a sigma_t'`, 1/mm^2: smooth where
        `sigma_a = 0`.
        """
        return 3 * self.sigma_a * self.sigma_t_prime


@record
class Layer(eqx.Module):
    r"""A slab of a scattering medium.

    **Attributes:** (differentiable)

    - `medium`: its coefficients, [channels].
    - `thickness`: mm; infinite for the lowest layer of a half space.

    **Raises:** `ValueError` for a negative thickness.
    """

    medium: Medium
    thickness: Float[Array, ""] = eqx.field(
        converter=numbers, metadata=valid("at least 0 (mm)", lambda x: x >= 0, finite=False)
    )

    @property
    def channels(self) -> int:
        return self.medium.channels

    def check_diffusion(self) -> None:
        """Raise `ValueError` for a slab thinner than a mean free path, whose sources would be
        outside of it. Traced values are not checked.
        """
        check_values(
            "thickness * sigma_t' of a Layer",
            self.thickness * self.medium.sigma_t_prime,
            "at least 1 in every channel, because diffusion is invalid in a thinner layer; "
            "use monte_carlo, or a Film, which absorbs without scattering",
            lambda x: x >= 1 - 1e-6,
            finite=False,
        )


@record
class Film(eqx.Module):
    r"""A layer that absorbs and does not scatter, of negligible thickness.

    It transmits `exp(-t)` of a beam from outside, and `2 E3(t)` of diffuse light, with t the
    optical depth.

    **Attributes:**

    - `optical_depth`: absorption coefficient times thickness, at least 0. Differentiable.

    **Source:** diffuse transmittance: the integral of `2 mu exp(-t / mu)` over the cosine.
    """

    optical_depth: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("at least 0", lambda x: x >= 0)
    )


def check_stack(layers: tuple[Layer | Film, ...]) -> None:
    """Raise `ValueError` for a stack without a layer that scatters, for numbers of channels that
    differ (a film may have one channel), and for an infinite layer above another. Traced
    thicknesses are not checked.
    """
    scattering = {layer.channels for layer in layers if isinstance(layer, Layer)}
    if not scattering:
        raise ValueError(
            f"layers must contain a scattering Layer; none of these {len(layers)} is one"
        )
    films = {layer.optical_depth.shape[-1] for layer in layers if isinstance(layer, Film)}
    counts = scattering | (films - {1})
    if len(counts) > 1:
        raise ValueError(f"layers have {sorted(counts)} channels; give all the same number")
    for number, layer in enumerate(layers[:-1], start=1):
        thickness = layer.thickness if isinstance(layer, Layer) else 0.0
        if not isinstance(thickness, Tracer) and np.isinf(thickness):
            raise ValueError(
                f"layer {number} of {len(layers)} is infinitely thick; only the lowest may be"
            )
