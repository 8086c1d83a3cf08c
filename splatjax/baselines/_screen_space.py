"""Screen-space diffusion (Jimenez): light is blurred in the finished picture's own buffers, along
rows and along columns.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax import shading as _shading, splatting as _splatting
from splatjax.exports import separable_kernel
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Camera, Frame, Material

from ._blur import Trust, blur_along

_SUPPORT = 3.75  # standard deviations of a Gaussian
_FOLLOWED = (
    3.0  # standard deviations of a Gaussian in depth, beyond which a pixel is on another surface
)


class AbstractScreenKernel(eqx.Module):
    """A blur in screen space. Pixels at another depth are replaced by the pixel's own light."""

    @abc.abstractmethod
    def diffuse(
        self,
        source: Float[Array, "channels height width"],
        depth: Float[Array, "height width"],
        pixels_per_mm: Float[Array, "height width"],
        gaussians: SumOfGaussians,
    ) -> tuple[Float[Array, "layers channels height width"], Float[Array, "layers channels"]]:
        """Compute layers, and weights; the weighted sum of the layers is the radiant exitance.
        Differentiable in the light's colors.
        """


class GaussianPasses(AbstractScreenKernel):
    """A separate blur for every Gaussian, along rows and along columns; on a frontal plane exactly
    the sum of Gaussians.

    **Attributes:**

    - `reach`: the farthest tap, pixels; wider blurs are limited to it. Static.

    **Source:** Jimenez, Sundstedt and Gutierrez 2009, the follow-surface test of Jimenez et al.
    2015.
    """

    reach: int = eqx.field(static=True, default=64)

    def diffuse(self, source, depth, pixels_per_mm, gaussians):
        layers = []
        for variance in gaussians.variances:
            width = jnp.minimum(variance * pixels_per_mm**2, (self.reach / _SUPPORT) ** 2)
            near = _follows(depth, _FOLLOWED * jnp.sqrt(variance))
            rows = source
            for axis in (1, 0):
                rows = blur_along(axis, rows, depth, near, width, self.reach).filled(rows)
            layers.append(rows)
        return jnp.stack(layers), gaussians.weights


class AbstractOneKernel(AbstractScreenKernel):
    """One kernel for the whole profile, a few taps along rows and the same along columns."""

    samples: int = eqx.field(static=True, default=25)

    @abc.abstractmethod
    def taps(
        self, gaussians: SumOfGaussians
    ) -> tuple[Float[Array, " samples"], Float[Array, "samples channels"]]:
        """Return offsets (mm), and weights that add up to 1 in each channel."""

    def diffuse(self, source, depth, pixels_per_mm, gaussians):
        offsets, weights = self.taps(gaussians)
        near = _follows(depth, jnp.max(offsets))
        rows = source
        for axis in (1, 0):
            blurred = jnp.zeros_like(rows)
            for offset, weight in zip(offsets, weights, strict=True):
                tap, trusted = _fetch(rows, depth, near, offset * pixels_per_mm, axis)
                blurred = blurred + weight[:, None, None] * (tap + (1 - trusted)[None] * rows)
            rows = blurred
        return rows[None], gaussians.total_reflectance()[None]


class ShippedKernel(AbstractOneKernel):
    """The kernel that ships with "Separable subsurface scattering": the radial profile at the taps
    (`splatjax.exports`).

    Two blurs by it give the profile only if that is a single Gaussian.

    **Source:** Jimenez et al. 2015, and the code that comes with it.
    """

    def taps(self, gaussians):
        return separable_kernel(gaussians, self.samples)


class PreintegratedKernel(AbstractOneKernel):
    """The profile summed along one axis, at the same taps: it is right for light that changes along
    one axis only.

    **Source:** Jimenez et al. 2015, section 3.2.
    """

    def taps(self, gaussians):
        offsets, _ = separable_kernel(gaussians, self.samples)
        steps = jnp.diff(offsets)
        widths = 0.5 * (jnp.append(steps, 0.0) + jnp.insert(steps, 0, 0.0))
        variances = gaussians.variances
        lines = (
            jnp.exp(-0.5 * (offsets * offsets)[:, None] / variances[None])
            / jnp.sqrt(2 * jnp.pi * variances)[None]
        )
        weights = widths[:, None] * (lines @ gaussians.weights)
        return offsets, weights / jnp.sum(weights, axis=0)[None]


def diffuse_on_screen(
    frame: Frame,
    camera: Camera,
    material: Material,
    kernel: AbstractScreenKernel = GaussianPasses(),
) -> Frame:
    r"""Replace the diffused light of a picture by a blur of its irradiance in screen space.

    Light outside of the camera's view is missing: behind silhouettes, and through thin parts.

    **Arguments:**

    - `frame`: from `splatjax.render` or `render_texture_space`; its irradiance, albedo, depth,
      normal and position are read. Differentiable.
    - `camera`, `material`: those of the frame. Specular parameters are those of the material: maps
      of `specular` and `roughness` are not among the buffers.
    - `kernel`: kernel of the blur.

    **Returns:** the frame with other `layers`, `weights`, `diffuse` and `beauty`.

    **Source:** Jimenez, Sundstedt and Gutierrez 2009; Jimenez et al. 2015.
    """
    view = _splatting.PerspectiveView.of(camera)
    is_covered = jnp.isfinite(frame.depth) & (frame.coverage > 0)
    share = jnp.where(is_covered, frame.coverage, 1.0)[..., None]
    root = _shading.albedo_root(frame.albedo / share)
    depth = stop_gradient(jnp.where(is_covered, frame.depth, 0.0))
    source = jnp.where(is_covered[..., None], frame.irradiance / share * root, 0.0).transpose(
        2, 0, 1
    )
    pixels_per_mm = view.focal_length / jnp.where(is_covered, depth, 1e6)
    layers, weights = kernel.diffuse(source, depth, pixels_per_mm, material.gaussians)
    to_eye = view.position[None, None] - frame.position
    surface = _shading.SurfacePoints(
        frame.position,
        frame.normal,
        _shading.unit_normals(to_eye),
        material.specular,
        material.roughness,
        [],
    )
    f0 = _shading.fresnel_f0(material.eta)
    transmission = jnp.moveaxis(
        _shading.exit_transmission(surface, f0, material.angular_law()), 0, -1
    )
    per_exitance = frame.coverage[..., None] * transmission / jnp.pi
    layers = (per_exitance * root)[None] * layers.transpose(0, 2, 3, 1)
    diffuse = jnp.sum(weights[:, None, None] * layers, axis=0)
    beauty = frame.beauty - frame.diffuse + diffuse
    return eqx.tree_at(
        lambda frame: (
            frame.layers,
            frame.weights,
            frame.diffuse,
            frame.beauty,
            frame.unresolved_fraction,
        ),
        frame,
        (layers, weights, diffuse, beauty, jnp.zeros_like(weights[:, 0])),
    )


def _follows(depth: Float[Array, "height width"], reach: Float[Array, ""]):
    """Return a tap's weight: it falls to 0 at a depth difference of `reach` mm, and is 0 without a
    surface.
    """
    return lambda tap: jnp.where(tap > 0, jnp.clip(1 - jnp.abs(tap - depth) / reach, 0, 1), 0.0)


def _fetch(
    rows: Float[Array, "rows height width"],
    depth: Float[Array, "height width"],
    near: Trust,
    offset: Float[Array, "height width"],
    axis: int,
) -> tuple[Float[Array, "rows height width"], Float[Array, "height width"]]:
    """Fetch trusted values at an offset (pixels) from each pixel, and their trust, by linear
    interpolation; beyond the border, from the last pixel.
    """
    size = depth.shape[axis]
    index = jnp.broadcast_to(
        jnp.expand_dims(jnp.arange(size, dtype=offset.dtype), 1 - axis), depth.shape
    )
    place = jnp.clip(index + offset, 0, size - 1)
    first = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, size - 2)
    beside = place - first.astype(place.dtype)
    across = jnp.arange(depth.shape[axis - 1], dtype=jnp.int32)  # the place along the other axis
    stacked = jnp.concatenate([rows, depth[None]]).transpose(1, 2, 0)
    sums, total = jnp.zeros((*depth.shape, len(rows)), rows.dtype), jnp.zeros_like(depth)
    for pixel, weight in ((first, 1 - beside), (first + 1, beside)):
        at = (pixel, across[None]) if axis == 0 else (across[:, None], pixel)
        tap = stacked.at[at].get(mode="promise_in_bounds")
        trusted = weight * near(tap[..., -1])
        sums, total = sums + trusted[..., None] * tap[..., :-1], total + trusted
    return sums.transpose(2, 0, 1), total
