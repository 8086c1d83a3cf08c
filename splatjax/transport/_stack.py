"""What photons walk through: layers as arrays, and the channels that walk alike."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from splatjax.scattering import Film, Layer

_FILM_THICKNESS = 1e-6
"""In free paths of the first layer that scatters: so thin that no light moves sideways in a film.
"""


def check_layers(layers: Sequence[Layer | Film]) -> None:
    """Raise if photons could not walk here, or not farther than a layer above the lowest. Traced
    thicknesses pass.
    """
    if not any(isinstance(layer, Layer) for layer in layers):
        raise ValueError(
            f"photons need a layer that scatters; got {len(layers)} layers, none of which is a "
            "Layer"
        )
    for number, layer in enumerate(layers[:-1], start=1):
        if (
            isinstance(layer, Layer)
            and not isinstance(layer.thickness, Tracer)
            and np.isinf(np.asarray(layer.thickness))
        ):
            raise ValueError(
                f"layer {number} of {len(layers)} is infinitely thick; only the lowest may be"
            )


class LayeredMedia(eqx.Module):
    r"""Layers, films among them, as arrays over all channels.

    **Attributes:**

    - `sigma_a`, `sigma_s`: 1/mm; a film does not scatter, and has its optical depth over its
      thickness.
    - `thickness`: mm.
    - `eta`: indices relative to air, those of the neighbors above and below included.
    - `first`: number of the uppermost layer that scatters.
    """

    sigma_a: Float[Array, "layers channels"]
    sigma_s: Float[Array, "layers channels"]
    thickness: Float[Array, "layers channels"]
    eta: Float[Array, "layers_and_neighbors channels"]
    first: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        layers: Sequence[Layer | Film],
        anisotropy: Float[Array, " layers"],
        eta_above: Float[Array, "*channels"],
        eta_below: Float[Array, "*channels"],
    ) -> "LayeredMedia":
        """Lay out layers from the top. A film has the index of what scatters below it, or above
        where nothing does.
        """
        scattering = [layer for layer in layers if isinstance(layer, Layer)]
        like = scattering[0].medium.sigma_a
        thin = _FILM_THICKNESS / jax.lax.stop_gradient(scattering[0].medium.sigma_s_prime)
        rows = []
        for number, layer in enumerate(layers):
            if isinstance(layer, Layer):
                medium, thickness = layer.medium, layer.thickness.astype(like.dtype)
                sigma_s = medium.sigma_s_prime / (1 - anisotropy[number])
                rows.append(
                    (medium.sigma_a, sigma_s, jnp.broadcast_to(thickness, like.shape), medium.eta)
                )
            else:
                below = [each for each in layers[number:] if isinstance(each, Layer)]
                eta = (below[0] if below else scattering[-1]).medium.eta
                rows.append((layer.optical_depth / thin, jnp.zeros_like(like), thin, eta))
        sigma_a, sigma_s, thickness, eta = (jnp.stack(column) for column in zip(*rows, strict=True))
        above, below = (
            jnp.broadcast_to(each.astype(like.dtype), like.shape)[None]
            for each in (eta_above, eta_below)
        )
        first = next(number for number, layer in enumerate(layers) if isinstance(layer, Layer))
        return cls(sigma_a, sigma_s, thickness, jnp.concatenate([above, eta, below]), first)

    @property
    def unit(self) -> Float[Array, " channels"]:
        """The free path between scatterings in the first layer that scatters, mm: walks are made in
        it.
        """
        return 1 / self.sigma_s[self.first]

    def stack(self, channel: Int[Array, ""]) -> "Stack":
        """Give the walk of one channel."""
        unit = self.unit[channel]
        return Stack(
            self.sigma_s[:, channel] * unit, self.thickness[:, channel] / unit, self.eta[:, channel]
        )

    def alike(self) -> list[np.ndarray]:
        """Give groups of channels, by number, whose photons walk alike: they differ in absorption
        and in scale alone.

        Under `jit` values are unknown, and each channel walks for itself.
        """
        channels = self.sigma_a.shape[1]
        known = (self.sigma_s, self.thickness, self.eta)
        if any(isinstance(each, Tracer) for each in known):
            return [np.asarray([channel]) for channel in range(channels)]
        sigma_s, thickness, eta = (np.asarray(each) for each in known)
        unit = 1 / sigma_s[self.first]
        walks = np.concatenate([sigma_s * unit, thickness / unit, eta])
        _, group = np.unique(walks, axis=1, return_inverse=True)
        return [np.flatnonzero(group == number) for number in range(group.max() + 1)]


class Stack(eqx.Module):
    r"""The geometry of a walk, in free paths of the first layer that scatters. A constant of every
    derivative.

    **Attributes:**

    - `sigma_s`: scattering coefficients; 0 in a film.
    - `thickness`: of each layer.
    - `eta`: indices relative to air, those of the neighbors above and below included.
    """

    sigma_s: Float[Array, " layers"]
    thickness: Float[Array, " layers"]
    eta: Float[Array, " layers_and_neighbors"]
