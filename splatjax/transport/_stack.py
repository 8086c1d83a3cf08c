"""The layers of a walk as arrays, and the channels that share a walk."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from splatjax.scattering import Film, Layer

# In free paths of the first layer that scatters: so thin that no light moves sideways in a film.
_FILM_THICKNESS = 1e-6


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
        """Lay out layers from the top. A film has the index of the next scattering layer below it,
        or else of the last one above.
        """
        scattering = [layer for layer in layers if isinstance(layer, Layer)]
        like = scattering[0].medium.sigma_a
        thin = _FILM_THICKNESS / jax.lax.stop_gradient(scattering[0].medium.sigma_s_prime)
        rows = []
        for number, layer in enumerate(layers):
            lower = [other for other in layers[number:] if isinstance(other, Layer)]
            medium = (lower or scattering[-1:])[0].medium
            if isinstance(layer, Film):
                rows.append((layer.optical_depth / thin, jnp.zeros_like(like), thin, medium.eta))
            else:
                sigma_s = medium.sigma_s_prime / (1 - anisotropy[number])
                thickness = jnp.broadcast_to(layer.thickness, like.shape)
                rows.append((medium.sigma_a, sigma_s, thickness, medium.eta))
        sigma_a, sigma_s, thickness, eta = (jnp.stack(column) for column in zip(*rows, strict=True))
        above, below = (jnp.broadcast_to(edge, (1, len(like))) for edge in (eta_above, eta_below))
        first = next(number for number, layer in enumerate(layers) if isinstance(layer, Layer))
        return cls(sigma_a, sigma_s, thickness, jnp.concatenate([above, eta, below]), first)

    @property
    def unit(self) -> Float[Array, " channels"]:
        """The free path between scatterings in the first layer that scatters, mm: the unit of
        length of walks.
        """
        return 1 / self.sigma_s[self.first]

    def stack(self, channel: Int[Array, ""]) -> "Stack":
        """Return the geometry of one channel, in its unit."""
        unit = self.unit[channel]
        return Stack(
            self.sigma_s[:, channel] * unit, self.thickness[:, channel] / unit, self.eta[:, channel]
        )

    def shared_walks(self) -> list[np.ndarray]:
        """Group the channels, by number, that differ in absorption and in scale alone: they share a
        walk.

        Under `jit` values are unknown, and each channel has its own walk.
        """
        geometry = (self.sigma_s, self.thickness, self.eta)
        if any(isinstance(values, Tracer) for values in geometry):
            return [np.asarray([channel]) for channel in range(self.sigma_a.shape[1])]
        sigma_s, thickness, eta = (np.asarray(values) for values in geometry)
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


def of_layer(
    table: Float[Array, "layers *channels"], layer: Int[Array, " photons"]
) -> Float[Array, "*channels photons"]:
    """Look up the entry of each photon's layer: by selections, which vectorize as a gather does
    not.
    """
    shape = (*table.shape[1:], *layer.shape)
    entry = jnp.broadcast_to(table[0][..., None], shape)
    for number in range(1, table.shape[0]):
        here = jnp.broadcast_to(layer == number, shape)
        entry = jnp.where(here, jnp.broadcast_to(table[number][..., None], shape), entry)
    return entry
