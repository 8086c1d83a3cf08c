"""The kernel of splat-based diffusion: spreading of light in a layer, truncation, normalization,
and resolution by the splats.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._smooth import smooth_step
from splatjax.scene import Splats

# The eighth root of exp(-x) as a polynomial, highest power first: the eighth power is within 2e-6,
# and hardly grows beyond the largest exponent in use, 10.13.
_ROOT = (
    -1.5162319954e-07,
    9.31495647343e-06,
    -3.22219821163e-04,
    7.80700544689e-03,
    -0.124996893065,
    0.999999743205,
)
_FADE = 0.5  # range of the exponent below its largest value in which the kernel fades to zero
_LEAST_TRUNCATED, _MOST_TRUNCATED = 4e-5, 0.1  # cut-off power: 4.5, 2.1 standard deviations
_LEAST_SHARE = 1e-3  # least share of the diffusion integral in a layer, for choosing its support
_UNEVEN = 0.05  # least unevenness of fully scattered splats
_SLACK = 1e-5  # rounding error of a total reflectance of 1
_TINY_ENERGY = 1e-12  # least energy that counts, and lower bound of divisors
_ROUNDING = 0.01  # excess over the mass of a flat sheet within which the gain's corner is rounded
_BENDS = 0.05, 10.0  # range of curvature over rate outside which simpler formulas are used
_LARGEST_DECAY = 3.0  # largest decay rate times layer width: wider layers of fits are not physical
_SHALLOW = 0.25  # least source depth, in standard deviations, used to infer curvature
_SAMPLE = 64  # splats whose nearest neighbors measure the unevenness


class TruncatedGaussian(eqx.Module):
    """`exp(-exponent)`, faded linearly to zero in the last `_FADE` before the largest exponent.

    Automatic differentiation ignores the derivative of a step, but not of the fade. In float32
    the exponential is the eighth power of a polynomial, within 2e-6 and at half the time, and its
    derivative is that of the polynomial.

    **Attributes:** not differentiated

    - `largest`: exponent of each kernel.
    """

    largest: Float[Array, " kernels"]

    def __call__(self, exponent: Float[Array, "kernels ..."]) -> tuple[Float[Array, "..."], ...]:
        """Compute the weight, and minus its derivative in the exponent."""
        gaussian, minus_slope = self._gaussian(exponent)
        largest = self.largest.astype(exponent.dtype).reshape(-1, *[1] * (exponent.ndim - 1))
        left = (largest - exponent) / _FADE
        fades = left < 1
        weight = jnp.where(fades, gaussian * left, gaussian)
        minus_slope = jnp.where(fades, minus_slope * left + gaussian / _FADE, minus_slope)
        inside = exponent < largest
        return jnp.where(inside, weight, 0.0), jnp.where(inside, minus_slope, 0.0)

    def _gaussian(self, exponent: Float[Array, "..."]) -> tuple[Float[Array, "..."], ...]:
        if exponent.dtype != jnp.float32:
            gaussian = jnp.exp(-exponent)
            return gaussian, gaussian
        root, slope = jnp.full_like(exponent, _ROOT[0]), jnp.zeros_like(exponent)
        for coefficient in _ROOT[1:]:
            root, slope = root * exponent + coefficient, slope * exponent + root
        square = root * root
        fourth = square * square
        return fourth * fourth, -8 * fourth * square * root * slope

    def integral(self, exponent: Float[Array, " kernels"]) -> Float[Array, " kernels"]:
        """Integrate the weight from an exponent (below the fade) on: the kernel's integral over a
        plane, in units of that of the Gaussian.
        """
        beyond = jnp.exp(-self.largest.astype(exponent.dtype))
        return jnp.exp(-exponent) - beyond * (math.expm1(_FADE) / _FADE)


class AbstractDiffusionKernel(eqx.Module):
    r"""The spreading of one layer of light from splats at `p_j` with normals `n_j` to a point `x`:

        L_k(x) = gain_k(x) sum_j A_j G(v_k, |x - q_j|) E_j / sum_j A_j G(v_k, |x - q_j|)
        q_j = p_j - depth sqrt(v_k) n_j

    Layers too narrow for the spacing of the splats (the root of a splat's area) are replaced by the
    surface's own irradiance, in a smooth step of the standard deviation per spacing. Splats on a
    regular grid resolve narrower layers than scattered ones.

    **Attributes:** (static)

    - `depth`: depth of the source of a layer below its splat, in standard deviations.
    - `regular`, `scattered`: standard deviations per spacing at which the resolution of a layer
      starts and is complete, on a regular grid and for scattered splats.
    """

    depth: float = eqx.field(static=True, default=0.0)
    regular: tuple[float, float] = eqx.field(static=True, default=(0.4, 0.8))
    scattered: tuple[float, float] = eqx.field(static=True, default=(1.0, 2.0))

    def depths(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Compute the depth of the source of each layer below its splat, mm."""
        return self.depth * jnp.sqrt(variances)

    def support(self, error: float, share: float) -> float:
        """Choose the radius, in standard deviations, beyond which half of `error` of a layer's
        power lies, if the diffusion integral is only a `share` of the layer.
        """
        truncated = max(0.5 * error / max(share, _LEAST_SHARE), _LEAST_TRUNCATED)
        return math.sqrt(2 * math.log(1 / min(truncated, _MOST_TRUNCATED)))

    def truncated(self, supports: Float[np.ndarray, " kernels"]) -> TruncatedGaussian:
        """Build kernels that are zero beyond a number of standard deviations."""
        return TruncatedGaussian(jnp.asarray(0.5 * np.square(supports), float))

    def interval(self, unevenness: Float[Array, ""]) -> Float[Array, "2"]:
        """Compute the standard deviations per spacing between which layers become resolved."""
        regular, scattered = (
            jnp.asarray(end, unevenness.dtype) for end in (self.regular, self.scattered)
        )
        return regular + jnp.clip(unevenness / _UNEVEN, 0, 1) * (scattered - regular)

    @abc.abstractmethod
    def gain(
        self,
        mass: Float[Array, "gaussians #channels *points"],
        variances: Float[Array, "gaussians ..."],
        energies: Float[Array, "gaussians channels *points"],
        single_scattering_albedo: Float[Array, "channels *points"],
    ) -> Float[Array, "gaussians #channels *points"]:
        r"""Compute the factor of each layer on its mean over the splats near a point.

        **Arguments:**

        - `mass`: the mass of the kernel on the surface, `sum_j A_j G(v_k, |x - q_j|)`, divided by
          its mass on a flat sheet: 1 on a flat sheet, 2 in a sheet much thinner than the layer is
          wide, less at open edges.
        - `variances`: mm^2, for each point or for all.
        - `energies`: weights times the albedo at the point: the fraction of the light that leaves a
          flat surface as each layer.
        - `single_scattering_albedo`: the fraction that leaves as single scattering.
        """


class PlainMean(AbstractDiffusionKernel):
    """The kernel of the paper: the mean over nearby splats. Constants are kept on any shape.

    **Source:** Kim et al. 2010, section 4.2.
    """

    def gain(self, mass, variances, energies, single_scattering_albedo):
        return jnp.ones_like(mass)


class EscapeNormalization(AbstractDiffusionKernel):
    r"""A kernel for which light escapes sooner from thin or convex parts, so that less is absorbed.

    This is the default. It corrects the color of ears, noses and other thin or strongly curved
    parts, which the plain mean of the paper gives the color of a flat surface.

    At the depth `z` below a flat surface diffused light decays as `exp(-kappa z)`. Below a surface
    of mean curvature `H` it decays more slowly, at the rate in a sphere of that curvature,

        rate = kappa coth(kappa / H) - H

    so less is absorbed. In a sum of Gaussians with weights `w_k` and variances `v_k`, another rate
    in place of `kappa`, for the same scattering, multiplies each weight by `exp(v_k (kappa^2 -
    rate^2) / 2)`. The fraction `W` of light that leaves a flat surface becomes `W / (W + (1 - W)
    rate / kappa)`, if the reflectance has the form `1 / (1 + c kappa)`, with a constant `c`.
    Gaussians fitted to a flat surface lack the tail that this needs, so their growth determines
    only each layer's share of the total growth:

        gain_k = 1 + s (exp(v_k (kappa^2 - rate_k^2) / 2) - 1)

    with one `s` for all layers. To first order in the curvature it is 1.

    The rate follows from the Gaussians, `kappa^2 = (1 - W) / v`, where `v` is the mean variance of
    the layers, weighted by their energies, for the same form of the reflectance.
    The curvature follows from `S_k`, the kernel's mass on the surface divided by its mass on a flat
    sheet: `H_k = (1 - 1 / S_k) / (depth sqrt(v_k))`, which is exact on spheres that are large
    against the layer. On a sheet much thinner than the layer is wide `S_k` is 2. A layer too wide
    for its body uses the greatest mass of the narrower ones. Two limits keep the gain finite: a
    `depth` below 0.25 counts as 0.25 in the curvature, and `kappa sqrt(v_k)` above 3 as 3 in the
    growth, since Gaussians of such a width are not those of a physical medium.

    The gain is 1 on flat surfaces, where S < 1 (open edges, concave parts), and without absorption.
    For non-negative weights with a sum of at most one, no more light leaves than entered, `sum_k
    w_k gain_k <= 1`; all of it leaves where the rate is 0. Negative weights of an unconstrained fit
    count as zero. The corner at `S = 1` is rounded over 0.01. Where layers have different
    curvatures, the rate of the total is their mean, weighted by `w_k v_k`.

    The source is below its splat, because the light that leaves has been inside. This makes a splat
    on the other side of a thin part nearer, and one across an air gap farther.

    **Source:** the diffusion equation in a sphere, where the rate is `kappa coth(kappa R) - 1 / R`;
    compared with path tracing in docs/bodies.md.
    """

    depth: float = eqx.field(static=True, default=0.75)

    def gain(self, mass, variances, energies, single_scattering_albedo):
        energies = jnp.where(energies >= 0, energies, 0.0)
        leaves = jnp.sum(energies, axis=0) + single_scattering_albedo
        # A sum of 1 is exact only to rounding, so its derivative must not be at a corner.
        absorbed = jnp.where(leaves <= 1 + _SLACK, 1 - leaves, 0.0)

        # The decay rate in units of the layer's width, kappa sqrt(v), and its square.
        variance = variances.reshape(*variances.shape, *[1] * (energies.ndim - variances.ndim))
        mean_variance = jnp.sum(energies * variance, axis=0) / jnp.maximum(leaves, _TINY_ENERGY)
        diffuses = jnp.sum(energies, axis=0) > _TINY_ENERGY
        squared = (absorbed / jnp.where(diffuses, mean_variance, 1.0))[None] * variance
        decay = jnp.sqrt(jnp.maximum(squared, _TINY_ENERGY))

        # The curvature in the same unit, by the greatest mass of all layers not wider. The
        # derivative of `jnp.max` would compare recomputed floats for equality.
        greatest = jnp.ones_like(variance * mass)
        layers = (jax.lax.split(rows, [1] * len(mass)) for rows in (variance, mass))
        for layer_variance, layer_mass in zip(*layers, strict=True):
            is_narrower = layer_variance <= variance
            greatest = jnp.where(is_narrower & (layer_mass > greatest), layer_mass, greatest)
        excess = greatest - 1
        excess = excess * excess / (excess + _ROUNDING)
        curvature = excess / (1 + excess) / max(self.depth, _SHALLOW)

        # The growth of each layer at the rate in a sphere of its curvature, and of the total at the
        # mean rate.
        slowed = _slowed(curvature / decay)
        squared = jnp.minimum(squared, _LARGEST_DECAY**2)
        grown = jnp.expm1(0.5 * squared * slowed * (2 - slowed))
        spread = energies * squared
        mean = _ratio(jnp.sum(spread * slowed, axis=0), jnp.sum(spread, axis=0))
        total = leaves * absorbed * mean / jnp.maximum(1 - absorbed * mean, _TINY_ENERGY)
        return 1 + grown * _ratio(total, jnp.sum(energies * grown, axis=0))[None]


def _ratio(part: Float[Array, "..."], whole: Float[Array, "..."]) -> Float[Array, "..."]:
    """Divide; 1 where the whole does not count."""
    counts = jnp.abs(whole) > _TINY_ENERGY
    return jnp.where(counts, part / jnp.where(counts, whole, 1.0), 1.0)


def _slowed(bend: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute the fraction `1 - coth(1 / bend) + bend` by which light decays more slowly in a
    sphere than below a plane; `bend` is the curvature over the rate.
    """
    slight = bend - 2 / jnp.expm1(2 / jnp.clip(bend, *_BENDS))
    inverse = 1 / jnp.maximum(bend, _BENDS[0])
    return jnp.where(bend < _BENDS[1], slight, 1 - inverse / 3 + inverse**3 / 45)


def resolved_fraction(
    variance: Float[Array, "..."], area: Float[Array, "..."], interval: Float[Array, "2"]
) -> Float[Array, "..."]:
    """Compute the fraction of a layer that is the diffusion integral, instead of the surface's own
    irradiance.

    A smooth step in the variance divided by the area of a splat; `interval` is from
    `AbstractDiffusionKernel.interval`.
    """
    return smooth_step(variance / area, interval[0] ** 2, interval[1] ** 2)


@eqx.filter_jit
def unevenness(splats: Splats) -> Float[Array, ""]:
    r"""Measure the unevenness of the splats: 0 on a regular grid, about 0.5 at random.

    It is the relative standard deviation, among 64 splats, of the distance to the nearest splat,
    divided by the root of the area. Splats without area do not count. Not differentiated.
    """
    if splats.count < 2:
        return jnp.zeros((), splats.centers.dtype)
    sampled = jnp.linspace(0, splats.count - 1, min(_SAMPLE, splats.count)).astype(jnp.int32)
    centers = jax.lax.stop_gradient(splats.centers).T

    def nearest(i):
        offset = centers - centers[:, i][:, None]
        squared = jnp.where(splats.areas > 0, jnp.sum(offset * offset, axis=0), jnp.inf)
        squared = squared.at[i].set(jnp.inf)
        return jnp.sqrt(jnp.min(squared) / jax.lax.stop_gradient(splats.areas[i]))

    distance = jax.lax.map(nearest, sampled)
    counts = jnp.isfinite(distance)
    mean = jnp.maximum(jnp.mean(distance, where=counts), jnp.finfo(distance.dtype).tiny)
    return jnp.where(jnp.any(counts), jnp.std(distance, where=counts) / mean, 0.0)
