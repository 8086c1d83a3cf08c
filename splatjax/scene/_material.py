"""Translucent materials: the Gaussians, the surface, and the angular law."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._records import check_values, numbers, record, require, valid
from splatjax.fitting import (
    AbstractModel,
    FixedTotalReflectance,
    LeastCount,
    NonNegativeWeights,
    TransportModel,
    fit_gaussians,
)
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import ANGULAR_POWERS, AngularLaw, Medium, SingleScattering

_NARROW = 1e-6  # mm^2: far narrower than any splat, so that the layer is unresolved


@record
class Material(eqx.Module):
    r"""A translucent material: diffusion below the surface and reflection at the surface.

        material = load_material("marble")
        material = Material.of_medium(Medium([0.02, 0.006, 0.015], [1.1, 1.3, 1.5], eta=1.6))
        material = Material(fit_gaussians(Dipole(load_medium("marble"))).gaussians, eta=1.5)

    `of_medium` fixes the sum of the weights to the total reflectance. `fit_gaussians` does so only
    with `weights=FixedTotalReflectance()`; otherwise the sum may differ by a few percent.

    **Attributes:** (differentiable, except `wavelengths`)

    - `gaussians`: the diffusion profile. The sum of its weights is the diffuse reflectance.
    - `eta`: index of refraction relative to air, positive. It determines how much light enters,
      whatever the strength of the lobe. With 1 the surface reflects nothing.
    - `specular`: strength of the specular lobe (rho_s), at least 0. With 1 the lobe reflects
      exactly the light that does not enter.
    - `roughness`: root mean square slope of the surface (m), at least 0; clamped to [0.05, 1] in
      rendering.
    - `single_scattering`: light that is scattered once, as a separate term; the Gaussians then
      represent the remaining light. `None`: the Gaussians represent all light.
    - `angles`: the dependence of the light of the Gaussians on the angles of entry and exit; `None`
      for none.
    - `medium`: optical coefficients, which `ShapeDiffuser` uses instead of Gaussians, single
      scattering and angles; or `None`.
    - `wavelengths`: the wavelength of each channel, 360 to 830 nm, ascending; `None` for channels
      such as red, green and blue. They only affect the colors of pictures (`io.picture_to_rgb`).

    **Raises:** `ValueError` for a value out of range, for wavelengths that do not ascend, and if
    `single_scattering`, `angles` or `wavelengths` does not have the number of channels of the
    Gaussians.
    """

    gaussians: SumOfGaussians
    eta: Float[Array, ""] = eqx.field(
        converter=numbers, default=1.4, metadata=valid("positive", lambda x: x > 0)
    )
    specular: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.18, metadata=valid("at least 0", lambda x: x >= 0)
    )
    roughness: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.3, metadata=valid("at least 0", lambda x: x >= 0)
    )
    single_scattering: SingleScattering | None = None
    angles: AngularLaw | None = None
    medium: Medium | None = None
    wavelengths: Float[Array, " channels"] | None = eqx.field(
        converter=numbers,
        default=None,
        metadata=valid("between 360 and 830 (nm)", lambda x: (x >= 360) & (x <= 830)),
    )

    def __check_init__(self):
        steps = jnp.diff(self.wavelengths) if isinstance(self.wavelengths, jax.Array) else None
        check_values("the steps of Material.wavelengths", steps, "positive (nm)", lambda x: x > 0)
        for name in ("single_scattering", "angles"):
            channels = getattr(getattr(self, name), "channels", self.channels)
            require(
                channels == self.channels,
                f"Material.{name} has {channels} channels, and Material.gaussians has "
                f"{self.channels}; give both the same number",
            )

    @classmethod
    def of_medium(
        cls,
        medium: Medium,
        count: int | LeastCount = 6,
        *,
        model: AbstractModel = TransportModel(),
        **surface: Any,
    ) -> "Material":
        """Fit a material to optical coefficients, as `splatjax fit` does. Differentiable in the
        medium. The fit has the precision of the medium; to reproduce the command's numbers, create
        the medium in float64 (`jax.enable_x64`).

        **Arguments:**

        - `medium`: coefficients, 1/mm.
        - `count`: number of Gaussians, or `LeastCount(error)` for the least that reaches an error.
        - `model`: the model of the profile, by default light transport with isotropic scattering;
          use `TransportModel(g=0.8)` for forward scattering.
        - `surface`: `specular`, `roughness` and `eta`; the default `eta` is that of the medium.

        **Raises:** `ValueError` as `fit_gaussians` does.
        """
        fitted = fit_gaussians(
            model.profile(medium),
            count,
            weights=NonNegativeWeights(FixedTotalReflectance()),
            rule=model.rule,
        )
        surface = {"eta": medium.eta[0]} | surface
        return cls(fitted.gaussians, angles=model.angles(medium), medium=medium, **surface)

    @property
    def channels(self) -> int:
        return self.gaussians.channels

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the diffuse reflectance of a flat surface for light along the normal."""
        return self.gaussians.total_reflectance() + self.single_scattering_albedo()

    def single_scattering_albedo(self) -> Float[Array, " channels"]:
        """Compute the part of the total reflectance due to light scattered once."""
        if self.single_scattering is None:
            return jnp.zeros_like(self.gaussians.weights, shape=self.channels)
        return self.single_scattering.total_reflectance()

    def angular_law(self) -> AngularLaw:
        """Return `angles` or, if it is `None`, the constant law 1 with as many powers as that of
        `HalfSpace`.
        """
        if self.angles is not None:
            return self.angles
        constant = np.eye(ANGULAR_POWERS, 1, dtype=self.gaussians.weights.dtype)
        return AngularLaw(jax.device_put(constant.repeat(self.channels, 1)))

    def diffuse_fraction(self, mu_i: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute the factor of the Gaussians for light that enters at the cosine `mu_i`. It is 1
        along the normal.

        Grazing light leaves after one scattering event more often than light along the normal. If
        single scattering and the Gaussians together exceeded 1, the Gaussians are reduced.
        """
        factor = self.angular_law()(mu_i)
        if self.single_scattering is None:
            return factor
        remaining = jnp.maximum(1 - self.single_scattering.directional_albedo(mu_i), 0)
        total = jnp.broadcast_to(self.gaussians.total_reflectance(), factor.shape)
        is_over = remaining < factor * total
        return jnp.where(is_over, remaining / jnp.where(is_over, total, 1.0), factor)

    def surface_of(self, gaussians: SumOfGaussians, angles: AngularLaw | None = None) -> "Material":
        """Return a material with other Gaussians and the surface of this one, without single
        scattering.
        """
        return dataclasses.replace(
            self, gaussians=gaussians, angles=angles, single_scattering=None, medium=None
        )

    def opaque(self) -> "Material":
        """Replace scattering by one Gaussian with the total reflectance, narrower than any
        splat.
        """
        variances = jnp.full_like(self.gaussians.variances, _NARROW, shape=(1,))
        return self.surface_of(SumOfGaussians(variances, self.total_reflectance()[None]))

    def white(self) -> "Material":
        """Scale the total reflectance to 1 per channel, so that an albedo map alone gives the
        color.

        **Raises:** `ValueError` for a black channel.
        """
        total, single = self.total_reflectance(), self.single_scattering
        check_values("total_reflectance", total, "positive, to be scaled to 1", lambda x: x > 0)
        gaussians = SumOfGaussians(self.gaussians.variances, self.gaussians.weights / total[None])
        if single is not None:
            single = SingleScattering(single.medium, single.strength / total)
        return dataclasses.replace(self, gaussians=gaussians, single_scattering=single, angles=None)
