"""Media, layers and interfaces: the Fresnel reflectance, its diffuse moments from inside, and the
boundary condition of diffusion.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values, is_traced, numbers, record, require, valid

from ._quadrature import unit_interval


@record
class Medium(eqx.Module):
    r"""The optical coefficients of a homogeneous material. `Material.of_medium` makes a material of
    them.

        Medium([0.020, 0.006, 0.015], [1.1, 1.3, 1.5], eta=1.6)
        Medium((1 - albedo) * sigma_t, albedo * sigma_t * (1 - g), eta)  # of extinction and albedo

    Divide coefficients in 1/cm by 10.

    **Attributes:** (any number of channels; a single number applies to all; differentiable)

    - `sigma_a`: absorption coefficient, 1/mm, at least 0.
    - `sigma_s_prime`: reduced scattering coefficient `sigma_s (1 - g)`, 1/mm, positive.
    - `eta`: index of refraction relative to air, positive.

    **Raises:** `ValueError` for a value out of these ranges. Traced values are not checked.
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
        """Square of the effective transport coefficient, `3 sigma_a sigma_t'`, 1/mm^2. Unlike the
        coefficient, it is smooth at `sigma_a = 0`.
        """
        return 3 * self.sigma_a * self.sigma_t_prime


@record
class Layer(eqx.Module):
    r"""A layer of a scattering medium between two parallel planes.

    **Attributes:** (differentiable)

    - `medium`: coefficients, [channels].
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
        """Raise `ValueError` for a slab thinner than one mean free path: its sources would lie
        outside. Traced values are not checked.
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
    r"""A layer of negligible thickness that absorbs without scattering.

    At the optical depth t it transmits `exp(-t)` of a beam from outside, and `2 E3(t)` of diffuse
    light.

    **Attributes:**

    - `optical_depth`: absorption coefficient times thickness, at least 0. Differentiable.

    **Source:** `2 E3(t)` is the integral of `2 mu exp(-t / mu)` over the cosine.
    """

    optical_depth: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("at least 0", lambda x: x >= 0)
    )


def check_stack(layers: tuple[Layer | Film, ...]) -> None:
    """Raise `ValueError` for a stack without a scattering layer, for unequal numbers of channels (a
    film may have one channel), and for an infinite layer above another layer. Traced thicknesses
    are not checked.
    """
    scattering = {layer.channels for layer in layers if isinstance(layer, Layer)}
    require(
        scattering, f"layers must contain a scattering Layer; none of these {len(layers)} is one"
    )
    films = {layer.optical_depth.shape[-1] for layer in layers if isinstance(layer, Film)}
    counts = scattering | (films - {1})
    require(len(counts) < 2, f"layers have {sorted(counts)} channels; give all the same number")
    for number, layer in enumerate(layers[:-1], start=1):
        thickness = layer.thickness if isinstance(layer, Layer) else 0.0
        require(
            is_traced(thickness) or np.isfinite(thickness),
            f"layer {number} of {len(layers)} is infinitely thick; only the lowest may be",
        )


class AbstractFresnel(eqx.Module):
    r"""The reflectance of a smooth interface for diffuse light from inside.

    `F(mu)` is the internal reflectance, including total internal reflection, and `eta` is the index
    inside divided by the index outside.
    """

    @abc.abstractmethod
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute `2 C1`, twice the integral of `mu F(mu)` over [0, 1]: the diffuse reflectance
        Fdr, in [0, 1).
        """

    @abc.abstractmethod
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute `3 C2`, three times the integral of `mu^2 F(mu)` over [0, 1], in [0, 1)."""

    def boundary(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        r"""Compute the boundary parameter `A = (1 + Fdr) / (1 - Fdr)` of the diffusion
        approximation; 1 at `eta = 1`.

        **Source:** Jensen et al. 2001, section 2.1.
        """
        reflectance = self.first_moment(eta)
        return (1 + reflectance) / (1 - reflectance)


class ExactFresnel(AbstractFresnel):
    r"""Compute the moments as exact integrals, split at the critical angle.

    Differentiable in `eta`. At `eta = 1` the moments are 0 and have a kink; the derivative there is
    the limit from above (7/3 for the first moment; from below it is -1/3).

    The integral over the cosine outside, `mu_o`, is transformed to `s = r_s`, the reflection
    coefficient of s-polarized light. Then `mu_o^2 = (eta^2 - 1)(1 - s)^2 / 4s` and `r_p = (s - b) /
    (1 - b s)` with `b = (eta^2 - 1) / (eta^2 + 1)`, so a power of `eta^2 - 1` multiplies an
    integral that is finite at `eta = 1`.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio, outside = _denser_over_rarer(eta), moment_outside(eta)
        return jnp.where(eta < 1, outside, 1 + (outside - 1) / (ratio * ratio))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio = _denser_over_rarer(eta)
        beyond_critical = (ratio * ratio - 1) ** 1.5
        # The cosine inside is sqrt(eta^2 - 1)(1 + s) / (2 eta sqrt(s)).
        sign = jnp.where(eta < 1, -1.0, 1.0)[None]
        integral = _over_reflections(ratio, lambda s: (1 + sign * s) / jnp.sqrt(s))
        transmitting = 3 / 32 * beyond_critical * integral
        return jnp.where(
            eta < 1, transmitting, (beyond_critical + transmitting) / (ratio * ratio * ratio)
        )


class EganFresnel(AbstractFresnel):
    r"""Compute the moments by the polynomial fits that published profiles use.

    The first moment is the fit of Egan and Hilgeman as printed by Donner and Jensen; the second is
    the fit of d'Eon and Irving. They are valid for `eta` between about 0.5 and 2. Differentiable
    except at `eta = 1`, where the fits step by 0.0017; there the moments are set to 0, so that A =
    1.

    **Source:** Egan and Hilgeman 1979; Donner and Jensen 2005; d'Eon and Irving 2011.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        inverse = 1 / eta
        above = _polynomial(inverse, -1.4399, 0.7099, 0.6681) + 0.0636 * eta
        below = _polynomial(inverse, 0.0636, -0.3319, 0.7099, -0.4399)
        return jnp.where(eta == 1, jnp.zeros_like(eta), jnp.where(eta < 1, below, above))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        above = _polynomial(1 / eta, 135.926, -656.175, 1376.53, -1641.1)
        above = above + eta * _polynomial(eta, 1.91826, -27.0181, 164.798, -568.556, 1213.67)
        below = _polynomial(eta, 0.145787, 0.236494, -1.95284, 3.36231, -2.62051, 0.828421)
        return jnp.where(eta == 1, jnp.zeros_like(eta), jnp.where(eta < 1, below, above))


def reflectance(
    inside: Float[Array, "*shape"], outside: Float[Array, "*shape"], eta: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Compute the reflectance of a smooth interface for unpolarized light from the cosines on both
    sides. It is the same from either side.
    """
    across = (eta * inside - outside) / (eta * inside + outside)
    along = (inside - eta * outside) / (inside + eta * outside)
    return 0.5 * (across * across + along * along)


def _polynomial(x: Float[Array, " channels"], *coefficients: float) -> Float[Array, " channels"]:
    return jnp.polyval(jnp.asarray(coefficients, x.dtype), x)


def moment_outside(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute twice the integral of `mu F(mu)` over the cosine on the rarer side, where there is no
    total reflection.
    """
    ratio = _denser_over_rarer(eta)
    return (ratio * ratio - 1) / 8 * _over_reflections(ratio, jnp.ones_like)


def _denser_over_rarer(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Divide the index of the denser side by that of the rarer side. At 1 the derivative is the
    limit from above.
    """
    return jnp.where(eta < 1, 1 / eta, eta)


def _over_reflections(ratio: Float[Array, " channels"], factor) -> Float[Array, " channels"]:
    """Integrate `(1 - s^2)(1 + (r_p / s)^2) factor(s)` from normal incidence, `s = (ratio - 1) /
    (ratio + 1)`, to 1: the reflectance times `factor` and `16 mu_o dmu_o / (ratio^2 - 1)`.
    """
    normal = ((ratio - 1) / (ratio + 1))[None]
    b = 2 * normal / (1 + normal * normal)
    x, _, weights = (jnp.asarray(values, ratio.dtype)[:, None] for values in unit_interval())
    s = normal + (1 - normal) * x
    along = (s - b) / (s * (1 - b * s))
    return jnp.sum(weights * (1 - normal) * (1 - s * s) * (1 + along * along) * factor(s), axis=0)
