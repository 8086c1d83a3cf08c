"""Stacks of layers."""

from collections.abc import Sequence
from functools import reduce

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ._adding import Response, film_response, slab_response
from ._fresnel import AbstractFresnel, ExactFresnel
from ._layers import Film, Layer
from ._slab import AbstractSlabProfile, slab_falls


class LayeredMultipole(AbstractSlabProfile):
    r"""Any number of layers, each a multipole, added in the Hankel domain.

    Between two scattering layers the interface has the ratio of their indices; a film has none of
    its own. Light comes from above as a narrow beam. Each slab keeps its own extrapolated
    boundaries, so that cutting one in two, indices matched, is not neutral: a few per cent at four
    mean free paths.

    Differentiable in every coefficient and thickness, and in `r`.

    **Attributes:**

    - `layers`: `Layer` and `Film`, from the top; at least one scatters. Only the lowest may be
      infinite.
    - `eta_above`, `eta_below`: indices of the neighbors relative to air, [channels].
    - `fresnel`: the diffuse Fresnel moments.
    - `surface`: those of the topmost interface, if it is another: `RoughFresnel(...)`.

    **Raises:** `ValueError` for no scattering layer, for an infinite layer with something below,
    and for a layer thinner than one mean free path `1 / sigma_t'` in any channel. Under `jit` that
    is unknown, and the profile NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layers: tuple[Layer | Film, ...]
    eta_above: Float[Array, " channels"]
    eta_below: Float[Array, " channels"]
    fresnel: AbstractFresnel
    surface: AbstractFresnel

    def __init__(
        self,
        layers: Sequence[Layer | Film],
        eta_above: Float[Array, " channels"] | float = 1.0,
        eta_below: Float[Array, " channels"] | float = 1.0,
        fresnel: AbstractFresnel | None = None,
        surface: AbstractFresnel | None = None,
    ):
        scattering = [layer for layer in layers if isinstance(layer, Layer)]
        if not scattering:
            raise ValueError(
                f"a profile needs a layer that scatters; got {len(layers)} layers, none of which "
                "is a Layer"
            )
        self.layers = _merged(layers)
        like = scattering[0].medium.eta
        self.eta_above, self.eta_below = (
            jnp.broadcast_to(jnp.asarray(eta, like.dtype), like.shape)
            for eta in (eta_above, eta_below)
        )
        self.fresnel = ExactFresnel() if fresnel is None else fresnel
        self.surface = self.fresnel if surface is None else surface

    def __check_init__(self):
        for number, layer in enumerate(self.layers[:-1], start=1):
            if isinstance(layer, Layer) and _is_infinite(layer):
                raise ValueError(
                    f"layer {number} of {len(self.layers)} is infinitely thick; only the lowest "
                    "may be"
                )
        for layer in self._scattering():
            layer.check_diffusion()

    def length_scale(self) -> Float[Array, " channels"]:
        """Give the mean free path of the uppermost layer that scatters, mm."""
        return 1 / self.top.medium.sigma_t_prime

    @property
    def top(self) -> Layer:
        """The uppermost layer that scatters."""
        return self._scattering()[0]

    def response(self, k: Float[Array, "*frequencies channels"]) -> Response:
        etas = [self.eta_above, *(layer.medium.eta for layer in self._scattering()), self.eta_below]
        responses, passed = [], 0
        for layer in self.layers:
            if isinstance(layer, Film):
                responses.append(film_response(layer, passed == 0, k.shape))
            else:
                above = self.surface if passed == 0 else self.fresnel
                responses.append(
                    slab_response(layer, etas[passed], etas[passed + 2], above, self.fresnel, k)
                )
                passed += 1
        return reduce(Response.over, responses)

    def _scattering(self) -> list[Layer]:
        return [layer for layer in self.layers if isinstance(layer, Layer)]

    def falls(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        each = [slab_falls(layer) for layer in self._scattering()]
        reflected = reduce(jnp.minimum, [fall for fall, _ in each])
        return reflected, sum((fall for _, fall in each[1:]), start=each[0][1])


def _merged(layers: Sequence[Layer | Film]) -> tuple[Layer | Film, ...]:
    """Make one film of films that lie on each other: light is not diffused between them."""
    merged: list[Layer | Film] = []
    for layer in layers:
        if merged and isinstance(layer, Film) and isinstance(merged[-1], Film):
            merged[-1] = Film(merged[-1].optical_depth + layer.optical_depth)
        else:
            merged.append(layer)
    return tuple(merged)


def _is_infinite(layer: Layer) -> bool:
    return not isinstance(layer.thickness, Tracer) and bool(jnp.isinf(layer.thickness))
