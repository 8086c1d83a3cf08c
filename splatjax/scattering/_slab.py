"""Profiles of slabs and of stacks of layers, added in the Hankel domain."""

import abc
from functools import reduce

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record, several
from splatjax.gaussians import AbstractProfile

from ._adding import Response, film_response, slab_response
from ._fresnel import AbstractFresnel, ExactFresnel
from ._hankel import inverse_hankel_transform
from ._medium import Film, Layer, check_stack

_SHALLOWEST = (
    1e-3  # mean free paths: the quadrature does not resolve a source nearer to the surface
)


class AbstractSlabProfile(AbstractProfile):
    """A profile with a transmittance beside its reflectance; both are inverse Hankel transforms.

    **Attributes:** (by keyword)

    - `eta_above`, `eta_below`: indices of the neighbors relative to air, [channels].
    - `fresnel`: the diffuse Fresnel moments.
    """

    eta_above: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0, kw_only=True)
    eta_below: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0, kw_only=True)
    fresnel: AbstractFresnel = eqx.field(default=ExactFresnel(), kw_only=True)

    @property
    @abc.abstractmethod
    def stack(self) -> tuple[Layer | Film, ...]:
        """All layers, from the top."""

    def __check_init__(self):
        check_stack(self.stack)
        for layer in self._scattering():
            layer.check_diffusion()

    @property
    def channels(self) -> int:
        return self.top.channels

    @property
    def top(self) -> Layer:
        """The uppermost layer that scatters."""
        return self._scattering()[0]

    def _scattering(self) -> list[Layer]:
        return [layer for layer in self.stack if isinstance(layer, Layer)]

    def response(self, k: Float[Array, "*frequencies channels"]) -> Response:
        """Compute reflectance and transmittance at spatial frequencies `k` (1/mm, at least 0)."""
        etas = [self.eta_above, *(layer.medium.eta for layer in self._scattering()), self.eta_below]
        responses, passed = [], 0
        for layer in self.stack:
            if isinstance(layer, Film):
                responses.append(film_response(layer, passed == 0, k.shape))
            else:
                neighbors = etas[passed], etas[passed + 2]
                responses.append(slab_response(layer, *neighbors, self.fresnel, k))
                passed += 1
        return reduce(Response.over, responses)

    def decay_lengths(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        """Compute lengths `a` (mm) such that reflectance and transmittance fall like `exp(-a k)` or
        faster: the depths of the sources from either side.
        """
        reflected, transmitted = [], []
        for layer in self._scattering():
            depth = 1 / layer.medium.sigma_t_prime
            beneath = jnp.maximum(layer.thickness - depth, _SHALLOWEST * depth)
            reflected.append(depth)
            # An infinite layer transmits nothing, and any length serves.
            transmitted.append(jnp.where(jnp.isfinite(beneath), beneath, depth))
        return reduce(jnp.minimum, reflected), sum(transmitted[1:], start=transmitted[0])

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path of the uppermost layer that scatters, mm."""
        return 1 / self.top.medium.sigma_t_prime

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return inverse_hankel_transform(
            lambda k: self.response(k).reflectance_above, r, self.decay_lengths()[0]
        )

    @jit_unless_traced
    def transmittance(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Compute the radiant exitance below per unit power entering above, at distance `r` (mm)
        from the axis; 1/mm^2.
        """
        return inverse_hankel_transform(
            lambda k: self.response(k).transmittance_down, r, self.decay_lengths()[1]
        )

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.response(jnp.zeros_like(self.length_scale())).reflectance_above

    @jit_unless_traced
    def total_transmittance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the entering power that leaves below."""
        return self.response(jnp.zeros_like(self.length_scale())).transmittance_down

    def transmitted(self) -> "Transmitted":
        """Return the transmittance as a profile, to be fitted like any other."""
        return Transmitted(self)


class Transmitted(AbstractProfile):
    """The light that leaves a slab on the far side, as a profile."""

    slab: AbstractSlabProfile

    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return self.slab.transmittance(r)

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the entering power that leaves on the far side."""
        return self.slab.total_transmittance()

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path, or the depth below the last source if that is larger, mm."""
        return jnp.maximum(self.slab.length_scale(), self.slab.decay_lengths()[1])


@record
class Multipole(AbstractSlabProfile):
    r"""The dipole of a slab: the infinite series of images between both of its sides, summed in
    closed form in the Hankel domain.

    A slab many mean free paths thick becomes `Dipole`. Differentiable in every coefficient, in the
    thickness, and in `r`.

    **Attributes:**

    - `layer`: medium and thickness.
    - `eta_above`, `eta_below`, `fresnel`: as `AbstractSlabProfile` has them.

    **Raises:** `ValueError` for a layer thinner than one mean free path `1 / sigma_t'` in any
    channel: its sources would lie outside of it. Under `jit` that is unknown, and the profile NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layer: Layer

    @property
    def stack(self) -> tuple[Layer | Film, ...]:
        return (self.layer,)


@record
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
    - `eta_above`, `eta_below`, `fresnel`: as `AbstractSlabProfile` has them.

    **Raises:** `ValueError` for no scattering layer, for an infinite layer with another below it,
    and for a layer thinner than one mean free path `1 / sigma_t'` in any channel. Under `jit` that
    is unknown, and the profile NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layers: tuple[Layer | Film, ...] = eqx.field(converter=several)

    @property
    def stack(self) -> tuple[Layer | Film, ...]:
        """All layers, adjacent films joined: light is not diffused between them."""
        joined: list[Layer | Film] = []
        for layer in self.layers:
            if joined and isinstance(layer, Film) and isinstance(joined[-1], Film):
                joined[-1] = Film(joined[-1].optical_depth + layer.optical_depth)
            else:
                joined.append(layer)
        return tuple(joined)
