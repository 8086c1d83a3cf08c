"""The contribution of a splat to the pixels around it: positions and weights of its fragments."""

import abc
import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import AbstractView, Footprints, SplattingSettings, fragment_weight

_NO_FILTER = 1e-3  # pixels; the width of a footprint must be positive


class Fragments(eqx.Module):
    """Fragments of splats in pixels."""

    weight: Float[Array, "..."]
    """0 where a splat has no fragment."""
    nearness: Float[Array, "..."]
    is_inside: Bool[Array, "..."]


class AbstractSplatKernel(eqx.Module):
    """The footprint of a splat. The weight of all kernels is `splatjax.splatting.fragment_weight`
    of a squared radius.
    """

    @abc.abstractmethod
    def footprints(
        self, splats: Splats, view: AbstractView, settings: SplattingSettings
    ) -> Footprints:
        """Project splats; the boxes contain all fragments."""

    @abc.abstractmethod
    def squared_radius(
        self,
        f: Footprints,
        view: AbstractView,
        dx: Float[Array, "..."],
        dy: Float[Array, "..."],
        nearness: Float[Array, "..."],
    ) -> Float[Array, "..."]:
        """Compute `rho^2` at offsets from the center (pixels); 1 or more where a splat has no
        fragment.
        """

    def nearness(
        self, f: Footprints, view: AbstractView, dx: Float[Array, "..."], dy: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Compute the nearness of the point where the ray hits the splat's plane, as everywhere in
        this renderer.
        """
        return f.nearness + f.slope_x * dx + f.slope_y * dy

    def fragments(
        self, f: Footprints, view: AbstractView, dx: Float[Array, "..."], dy: Float[Array, "..."]
    ) -> Fragments:
        """Compute fragments at offsets from the center. Differentiable in the footprints."""
        nearness = self.nearness(f, view, dx, dy)
        squared = self.squared_radius(f, view, dx, dy, nearness)
        is_inside = f.visible & (squared < 1)
        weight = jnp.where(is_inside, fragment_weight(jnp.where(is_inside, squared, 1.0)), 0.0)
        return Fragments(f.opacity * weight, jnp.where(is_inside, nearness, 1.0), is_inside)


class DiscKernel(AbstractSplatKernel):
    """The disc itself, in exact perspective, without a filter. A disc smaller than a pixel is
    missed, or fills the pixel.

    **Source:** Zwicker et al. 2004, "Perspective Accurate Splatting"; Botsch et al. 2004, "Phong
    Splatting".
    """

    def footprints(self, splats, view, settings):
        return view.footprints(splats, dataclasses.replace(settings, filter_radius=_NO_FILTER))

    def squared_radius(self, f, view, dx, dy, nearness):
        return _in_perspective(f, view, dx, dy, nearness)


class EwaKernel(AbstractSplatKernel):
    r"""The elliptical weighted average: the disc's Gaussian, projected by the affine map at its
    center and blurred by the pixel's filter.

    In the picture the kernel is similar to `exp(-d^T (J V J^T + I)^-1 d / 2)`, where `I` is the
    variance of the pixel's filter, and is cut off where the renderer's kernel ends. The projection
    is exact only at the center: large splats near the eye may leave holes.

    **Attributes:**

    - `filter_variance`: variance of the pixel's filter, pixels squared. Static.

    **Source:** Zwicker et al. 2001, "Surface Splatting", section 4.2; Heckbert 1989, "Fundamentals
    of Texture Mapping and Image Warping".
    """

    filter_variance: float = eqx.field(static=True, default=1.0)

    def footprints(self, splats, view, settings):
        # exp(-4 rho^2) has an eighth of the squared radius as its variance
        f = view.footprints(
            splats, dataclasses.replace(settings, filter_radius=(8 * self.filter_variance) ** 0.5)
        )
        a, b, c = stop_gradient(self._quadric(f, view))
        determinant = a * c - 0.25 * b * b
        x, y = stop_gradient(f.x), stop_gradient(f.y)
        across, down = jnp.sqrt(c / determinant), jnp.sqrt(a / determinant)
        return dataclasses.replace(f, box=(x - across, x + across, y - down, y + down))

    def squared_radius(self, f, view, dx, dy, nearness):
        a, b, c = self._quadric(f, view)
        return dx * (a * dx + b * dy) + c * dy * dy

    @staticmethod
    def _quadric(f: Footprints, view: AbstractView):
        """Compute the ellipse of the affine map: the ellipse in perspective, but with the nearness
        of the center everywhere.
        """
        nearness = jnp.where(f.visible, f.nearness, 1.0)
        return tuple(view.squared_radius(nearness, coefficient) for coefficient in (f.a, f.b, f.c))


class DiscOrPixelKernel(AbstractSplatKernel):
    r"""The disc in exact perspective, or a circle of a pixel's size around its center, whichever
    has the larger weight.

    `rho^2 = min(rho_disc^2, d^2 / 2)`: an approximation of the elliptical weighted average in which
    no splat is smaller than a pixel, but whose weights are not those of a convolution.

    **Attributes:**

    - `pixel_radius`: radius of the circle, pixels. Static.

    **Source:** Botsch et al. 2005, "High-Quality Surface Splatting on Today's GPUs", section 5.
    """

    pixel_radius: float = eqx.field(static=True, default=2**0.5)

    def footprints(self, splats, view, settings):
        f, reach = DiscKernel().footprints(splats, view, settings), self.pixel_radius
        x, y = stop_gradient(f.x), stop_gradient(f.y)
        left, right, top, bottom = f.box
        wide = view.footprints(splats, dataclasses.replace(settings, filter_radius=reach))
        return dataclasses.replace(
            f,
            shift=wide.shift,
            opacity=jnp.where(f.visible, jnp.ones_like(f.opacity), 0.0),
            box=(
                jnp.minimum(left, x - reach),
                jnp.maximum(right, x + reach),
                jnp.minimum(top, y - reach),
                jnp.maximum(bottom, y + reach),
            ),
        )

    def nearness(self, f, view, dx, dy):
        """Compute the nearness; beyond the disc, use the nearness of its rim, because planes seen
        edge on would otherwise be too near.
        """
        plane = super().nearness(f, view, dx, dy)
        squared = _in_perspective(f, view, dx, dy, plane)
        beyond = stop_gradient(squared) > 1
        shrink = jnp.where(
            beyond, 1 / jnp.sqrt(jnp.where(beyond, jnp.minimum(squared, 1e12), 1.0)), 1.0
        )
        return super().nearness(f, view, shrink * dx, shrink * dy)

    def squared_radius(self, f, view, dx, dy, nearness):
        disc = _in_perspective(f, view, dx, dy, super().nearness(f, view, dx, dy))
        return jnp.minimum(disc, (dx * dx + dy * dy) / self.pixel_radius**2)


def _in_perspective(f: Footprints, view: AbstractView, dx, dy, nearness) -> Float[Array, "..."]:
    """Compute `rho^2` of the ray's hit with the disc's plane; infinite where the ray misses the
    rim.
    """
    quadric = dx * (f.a * dx + f.b * dy) + f.c * dy * dy
    inside = f.visible & view.inside(nearness, quadric)
    nearness, quadric = jnp.where(inside, nearness, 1.0), jnp.where(inside, quadric, 0.0)
    return jnp.where(inside, view.squared_radius(nearness, quadric), jnp.inf)
