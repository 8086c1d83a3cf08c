"""A rough interface."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values, numbers, record

from ._fresnel import AbstractFresnel, ExactFresnel, reflectance
from ._quadrature import unit_legendre

_COSINES, _SLOPES, _STEEPEST = 24, 64, 4.0
"""Nodes on each side of the critical angle; nodes of either slope, which end where they are 1e-7 as
frequent as none.
"""


@record
class RoughFresnel(AbstractFresnel):
    r"""The moments of an interface of microfacets: a rough surface over a material.

    Light from inside meets a facet with the probability that it sees it (Smith's masking,
    Beckmann's slopes), and is reflected by it or leaves; what it meets afterwards is neglected.
    With all facets reflecting everything the moments are 1, and without roughness they are those of
    `smooth`.

    Differentiable in `eta` and `roughness`, and in the latter to first order at 0, where the
    derivative is 0. At `eta = 1` itself the derivative in `eta` is that of `smooth`: what roughness
    takes from it close by is not in it.

    **Attributes:**

    - `roughness`: root mean square slope m, in [0, 1], as `Material` has it.
    - `smooth`: moments of the smooth interface; by default the exact ones.

    **Source:** that a rough surface changes the diffuse reflectance of the boundary condition:
    Donner and Jensen 2005; visible facets: Heitz 2014.
    """

    roughness: Float[Array, ""] = eqx.field(converter=numbers)
    smooth: AbstractFresnel = ExactFresnel()

    def __check_init__(self):
        check_values(
            "RoughFresnel.roughness", self.roughness, "in [0, 1]", lambda x: (x >= 0) & (x <= 1)
        )

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        return self.smooth.first_moment(eta) + self._excess(eta, power=1)

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        return self.smooth.second_moment(eta) + self._excess(eta, power=2)

    def _excess(self, eta: Float[Array, " channels"], power: int) -> Float[Array, " channels"]:
        """Compute what roughness adds to a moment: the difference of two sums over the same
        cosines.
        """
        cosine, share = _cosines(eta)
        along, across, weights = (
            jnp.asarray(values, eta.dtype)[..., None] for values in _slopes(len(cosine))
        )
        slope, shape = self.roughness.astype(eta.dtype), (*along.shape[:2], len(eta))
        cosines, sines, facet_slopes, lengths, weights = (
            jnp.broadcast_to(values, shape)
            for values in (
                cosine[:, None],
                jnp.sqrt(1 - cosine * cosine)[:, None],
                slope * along,
                jnp.sqrt(1 + slope * slope * (along * along + across * across)),
                weights,
            )
        )
        # The part of a facet of slope (p, q) that a direction in the plane of p sees, and the
        # cosine under which it meets the facet.
        seen = jnp.maximum(cosines + facet_slopes * sines, 0)
        reflected = _internal_reflectance(seen / lengths, eta)
        weights = weights * seen
        rough = jnp.sum(weights * reflected, axis=1) / jnp.sum(weights, axis=1)
        excess = rough - _internal_reflectance(cosine, eta)
        return jnp.sum((power + 1) * share * cosine**power * excess, axis=0)


def _internal_reflectance(
    cosine: Float[Array, "*shape channels"], eta: Float[Array, " channels"]
) -> Float[Array, "*shape channels"]:
    """Compute the unpolarized Fresnel reflectance at a cosine inside, where the index is `eta`
    times that outside.
    """
    eta = jnp.broadcast_to(eta, cosine.shape)
    squared = 1 - eta * eta * (1 - cosine * cosine)
    leaves = squared > 0
    outside = jnp.sqrt(jnp.where(leaves, squared, jnp.ones_like(squared)))
    return jnp.where(leaves, reflectance(cosine, outside, eta), jnp.ones_like(squared))


def _cosines(
    eta: Float[Array, " channels"],
) -> tuple[Float[Array, "cosines channels"], Float[Array, "cosines channels"]]:
    """Compute nodes and weights over the cosine inside, on either side of the critical angle,
    beyond which the reflectance begins as a root.
    """
    t, dt = (jnp.asarray(values, eta.dtype)[:, None] for values in unit_legendre(_COSINES))
    denser = eta > 1
    critical = jnp.where(denser, jnp.sqrt(1 - 1 / jnp.where(denser, eta * eta, 2)), 0.0)
    shape = (_COSINES, len(eta))
    t, dt, critical = (jnp.broadcast_to(values, shape) for values in (t, dt, critical))
    # Below as well: the transmittance of a rough interface begins as a root there.
    below = jnp.where(critical > 0, critical * (1 - t * t), t)
    above = critical + (1 - critical) * t * t
    weights = [critical * 2 * t * dt, (1 - critical) * 2 * t * dt]
    return jnp.concatenate([below, above]), jnp.concatenate(weights)


@functools.cache
def _slopes(cosines: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute slopes of unit roughness along and across, and their weights up to a factor:
    [cosines, slopes].

    Equal spacing is exact for a Gaussian, whatever the offset. Each cosine has its own offset, so
    that the errors of single sums at the critical angle average out.
    """
    step = 2 * _STEEPEST / _SLOPES
    offsets = np.modf(np.outer(np.arange(1, cosines + 1), (0.7548776662, 0.5698402910)))[
        0
    ]  # of an even sequence in the plane
    lines = step * (np.arange(_SLOPES) + offsets[..., None]) - _STEEPEST
    p = np.repeat(lines[:, 0], _SLOPES, axis=1)
    q = np.tile(lines[:, 1], (1, _SLOPES))
    return p, q, np.exp(-p * p - q * q)
