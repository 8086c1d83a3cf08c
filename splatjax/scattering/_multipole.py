"""One slab."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._adding import Response, slab_response
from ._fresnel import AbstractFresnel, ExactFresnel
from ._layers import Layer
from ._slab import AbstractSlabProfile, slab_falls


class Multipole(AbstractSlabProfile):
    r"""The dipole of a slab: the infinite series of images between both of its sides, summed in
    closed form in the Hankel domain.

    A slab many mean free paths thick becomes `Dipole`. Differentiable in every coefficient, in the
    thickness, and in `r`.

    **Attributes:**

    - `layer`: medium and thickness.
    - `eta_above`, `eta_below`: indices of the neighbors relative to air, [channels].
    - `fresnel`: the diffuse Fresnel moments.
    - `surface`: those of the upper side, if it is another: `RoughFresnel(...)`.

    **Raises:** `ValueError` for a layer thinner than one mean free path `1 / sigma_t'` in any
    channel: its light would come from outside of it. Under `jit` that is unknown, and the profile
    NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layer: Layer
    eta_above: Float[Array, " channels"]
    eta_below: Float[Array, " channels"]
    fresnel: AbstractFresnel
    surface: AbstractFresnel

    def __init__(
        self,
        layer: Layer,
        eta_above: Float[Array, " channels"] | float = 1.0,
        eta_below: Float[Array, " channels"] | float = 1.0,
        fresnel: AbstractFresnel | None = None,
        surface: AbstractFresnel | None = None,
    ):
        like = layer.medium.eta
        self.layer = layer
        self.eta_above, self.eta_below = (
            jnp.broadcast_to(jnp.asarray(eta, like.dtype), like.shape)
            for eta in (eta_above, eta_below)
        )
        self.fresnel = ExactFresnel() if fresnel is None else fresnel
        self.surface = self.fresnel if surface is None else surface

    def __check_init__(self):
        self.layer.check_diffusion()

    def response(self, k: Float[Array, "*frequencies channels"]) -> Response:
        return slab_response(
            self.layer, self.eta_above, self.eta_below, self.surface, self.fresnel, k
        )

    def falls(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        return slab_falls(self.layer)

    def length_scale(self) -> Float[Array, " channels"]:
        return 1 / self.layer.medium.sigma_t_prime
