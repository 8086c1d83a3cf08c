"""Layer potentials on the surface of a body, and paths through it: sums over all its splats, with
the Green's function of the diffusion equation, softened within their spacing.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats

from ._hierarchy import Clusters, Hierarchy, cluster_totals, padded

GRAZING = 1e-3  # cosine
_OVERLAP = 1.5  # radius of a splat over the root of its area
_SMALL = 0.1  # squared distance, in softening lengths, below which a series is used
_NODES, _REACH = 12, 4.0  # of the integral of the removed part: nodes, and end in softening lengths
_SCALE = 2 / math.sqrt(math.pi)
# The series of `erf(sqrt(q)) / sqrt(q)` up to the eighth power of q.
_SERIES = [_SCALE * (-1) ** n / (math.factorial(n) * (2 * n + 1)) for n in range(8, -1, -1)]
SOFTENED = 3.0  # softening lengths beyond which the kernel is not softened


class ScreenedKernel(eqx.Module):
    r"""`G = exp(-kappa r) / (4 pi r)`, with the distance softened:

        r_s = r / erf(r / length)

    It is smooth, points of a surface at most `length` apart resolve it, and it is `G` beyond three
    lengths. The part that softening removes is integrated over a plane through each point.

    **Attributes:** (differentiable)

    - `kappa`: 1/mm.
    - `length`: mm.
    """

    kappa: Float[Array, "channels"]
    length: Float[Array, ""]

    def near(self, squared_distances: Float[Array, "*pairs"]) -> list[tuple]:
        """Compute the softened kernel of every channel, 1/mm, and `-1/r` times its derivative in
        `r`, 1/mm^3.
        """
        inverse, fall = self._softening(squared_distances)
        distance, inverse, fall = 1 / inverse, inverse / (4 * math.pi), fall / (4 * math.pi)

        def of_channel(kappa):
            exponent = kappa * distance
            screened = jnp.exp(-exponent)
            return inverse * screened, fall * (1 + exponent) * screened

        return [of_channel(kappa) for kappa in self.kappa]

    def far(self, squared_distances: Float[Array, "*pairs"]) -> list[tuple]:
        """Compute the kernel beyond three lengths, 1/mm, and apply `-1/r d/dr` once, 1/mm^3, and
        twice, 1/mm^5. All are finite at distance 0.
        """
        inverse = jax.lax.rsqrt(jnp.where(squared_distances > 0, squared_distances, 1.0))
        distance, squared = squared_distances * inverse, inverse * inverse

        def of_channel(kappa):
            exponent = kappa * distance
            value = jnp.exp(-exponent) * inverse / (4 * math.pi)
            once, twice = 1 + exponent, 3 + exponent * (3 + exponent)
            return value, value * squared * once, value * squared * squared * twice

        return [of_channel(kappa) for kappa in self.kappa]

    def _softening(self, squared_distances):
        """Compute `1 / r_s`, and `-1/r` times its derivative in `r`."""
        q = squared_distances / (self.length * self.length)
        near = q < _SMALL
        away = jnp.where(near, 1.0, q)
        root, small = jnp.sqrt(away), jnp.where(near, q, 0.0)
        ratio = jax.scipy.special.erf(root) / root
        fall = (ratio - _SCALE * jnp.exp(-away)) / away
        series, slope = (jnp.asarray(s, q.dtype) for s in (_SERIES, -2 * np.polyder(_SERIES)))
        ratio = jnp.where(near, jnp.polyval(series, small), ratio)
        fall = jnp.where(near, jnp.polyval(slope, small), fall)
        return ratio / self.length, fall / self.length**3

    def plane_integral(self, height: Float[Array, "channels *points"]) -> Float[Array, "..."]:
        """Integrate the part that softening removes over a plane, mm.

        **Arguments:**

        - `height`: of the point over the plane, mm.
        """
        kappa = self.kappa.reshape(-1, *[1] * (height.ndim - 1))
        end = _REACH * self.length
        span = jnp.maximum(end - jnp.abs(height), 0)

        def removed(fraction):
            r = end - span * (1 - fraction)
            inverse, _ = self._softening(r * r)
            return jnp.exp(-kappa * r) - r * inverse * jnp.exp(-kappa / inverse)

        return 0.5 * span * integrate(removed, _NODES, height)


def integrate(
    function: Callable[[Array], Float[Array, "*shape"]], nodes: int, like: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Integrate a function from 0 to 1 by Gauss and Legendre's rule, one node after the other; its
    values have the shape of `like`.
    """
    x, weights = np.polynomial.legendre.leggauss(nodes)
    rule = jnp.asarray(np.stack([(1 + x) / 2, weights / 2], axis=1), like.dtype)

    def add(total, node_and_weight):
        return total + node_and_weight[1] * function(node_and_weight[0]), None

    return jax.lax.scan(jax.checkpoint(add), jnp.zeros_like(like), rule)[0]


class SurfaceSums(eqx.Module):
    """The splats of a body as planes, padded, and their near splats and clusters.

    **Attributes:**

    - `clusters`: weighted by area.
    """

    hierarchy: Hierarchy
    centers: Float[Array, "3 splats"]
    normals: Float[Array, "3 splats"]
    areas: Float[Array, " splats"]
    clusters: Clusters

    @classmethod
    def of(cls, splats: Splats, hierarchy: Hierarchy) -> "SurfaceSums":
        if splats.weights is not None:
            raise ValueError(
                "splats.weights has factors on Gaussians, which ShapeDiffuser does not read; give "
                "weights=None, or render with ClusterDiffuser"
            )
        centers, normals, areas = padded((splats.centers.T, splats.normals.T, splats.areas))
        return cls(hierarchy, centers, normals, areas, Clusters.of(centers, areas))

    def layers(
        self,
        kernel: ScreenedKernel,
        charges: Float[Array, " channels"],
        strengths: Float[Array, "channels splats"],
        dipole: float = 1.0,
    ) -> Float[Array, "channels splats"]:
        """Compute `int (c G + d dG/dn_y) f dA`, of every channel with its own c, 1/mm, and d the
        strength of the dipole.
        """
        facing, powers = dipole * self.normals, self.areas[None] * strengths

        def near(x, sources):
            strengths, normals, y = sources
            offset = _offset(x, y)
            across = dot(offset, normals)
            return [
                jnp.sum((charge * value - slope * across) * strength, axis=1)
                for charge, strength, (value, slope) in zip(
                    charges, strengths, kernel.near(dot(offset, offset)), strict=True
                )
            ]

        def far(x, sources):
            totals, dipoles, y, moments = sources
            offset = _offset(x, y)
            trace, along = _second_moments(moments, offset)
            return [
                jnp.sum(
                    total * (value + along * twice - trace * once) - dot(offset, dipole) * once,
                    axis=1,
                )
                for total, dipole, (value, once, twice) in zip(
                    totals, dipoles, kernel.far(dot(offset, offset)), strict=True
                )
            ]

        centers, moments = self.clusters.centers, self.clusters.moments
        totals = charges[:, None] * cluster_totals(powers)
        about_origin = powers[:, None] * (
            charges[:, None, None] * self.centers[None] + facing[None]
        )
        dipoles = cluster_totals(about_origin) - totals[:, None] * centers[None]
        inputs = (powers, facing, self.centers), (totals, dipoles, centers, moments)
        return self.hierarchy.reduce(near, far, self.centers, *inputs)

    def potential(
        self,
        kernel: ScreenedKernel,
        charges: Float[Array, " splats"],
        places: Float[Array, "3 splats"],
    ) -> Float[Array, " splats"]:
        """Compute `sum_j q_j G` of charges below the splats, for a kernel of one channel, 1/mm.

        **Arguments:**

        - `places`: of the charges, mm.
        """

        def near(x, sources):
            charges, y = sources
            offset = _offset(x, y)
            ((value, _),) = kernel.near(dot(offset, offset))
            return [jnp.sum(charges * value, axis=1)]

        def far(x, clusters):
            offset = _offset(x, clusters.centers)
            trace, along = _second_moments(clusters.moments, offset)
            # In thin parts light scatters nearer to the far side than its splats are: the trace,
            # added to the squared distance, keeps sums finite and positive.
            ((value, _, twice),) = kernel.far(dot(offset, offset) + 2 * trace)
            return [jnp.sum(clusters.totals * (value + along * twice), axis=1)]

        merged = Clusters.of(places, charges)
        return self.hierarchy.reduce(near, far, self.centers, (charges, places), merged)[0]

    def first_exits(
        self,
        directions: Float[Array, "3 splats"],
        starts: Bool[Array, " splats"],
        rows: Float[Array, "rows splats"],
    ) -> tuple[Float[Array, " splats"], Float[Array, " splats"], Float[Array, "rows splats"]]:
        """Follow a ray from each splat to its exit from the body. The choice of the exit splat is
        discontinuous.

        **Arguments:**

        - `starts`: the splats with a ray.
        - `rows`: values to read at the exit.

        **Returns:** the length, in lengths of the direction, infinite without an exit and 0 without
        a ray; the cosine of the exit; and the rows there.
        """

        def crossing(ray, discs):
            (x, way), (y, facing) = ray, discs
            cosine, squared_area = dot(way, facing), dot(facing, facing)
            area = jnp.sqrt(jnp.where(squared_area > 0, squared_area, 1.0))
            is_outward = (cosine > GRAZING * area) & (squared_area > 0)
            offset = _offset(x, y)
            t = dot(offset, facing) / jnp.where(is_outward, cosine, 1.0)
            miss = [o - t * w for o, w in zip(offset, way, strict=True)]
            missed = dot(miss, miss) / area
            return is_outward & (t > 0) & (missed < _OVERLAP**2), t, missed, area, cosine / area

        def first(ray, discs):
            is_hit, t, *_ = crossing(ray, discs)
            return [jnp.min(jnp.where(is_hit, t, jnp.inf), axis=1)]

        def blend(ray, discs):
            ray, first, (discs, rows) = ray[:2], ray[2], discs
            is_hit, t, missed, area, cosine = crossing(ray, discs)
            is_near = is_hit & (t < first + jnp.sqrt(area))
            weight = jnp.where(is_near, jnp.exp(-6 * jnp.where(is_near, missed, 0.0)), 0.0)
            return [jnp.sum(weight * row, axis=1) for row in (1.0, t, cosine, *rows)]

        facing, total = self.areas[None] * self.normals, self.clusters.totals
        discs = (self.centers, facing), (self.clusters.centers, cluster_totals(facing))
        means = cluster_totals(self.areas[None] * rows) / jnp.where(total > 0, total, 1.0)[None]
        rays = self.centers, directions
        starts_of = self.hierarchy.reduce(
            first, first, rays, *discs, combine=jax.ops.segment_min, join=jnp.minimum, used=starts
        )
        (start,) = jax.lax.stop_gradient(starts_of)
        sources = zip(discs, (rows, means), strict=True)
        sums = self.hierarchy.reduce(blend, blend, (*rays, start), *sources, used=starts)
        is_hit = starts & (sums[0] > 0)
        means = sums[1:] / jnp.where(is_hit, sums[0], 1.0)[None]
        length = jnp.where(is_hit, means[0], jnp.where(starts, jnp.inf, 0.0))
        return length, means[1], means[2:]

    def slopes(self, rows: Float[Array, "rows splats"]) -> Float[Array, "rows 3 splats"]:
        """Fit the slopes of rows along the surface, 1/mm, over about two spacings."""
        spread = jnp.sum(self.areas**2) / jnp.sum(self.areas)

        def moments(target, source):
            (x, normals), (y, facing, areas, rows) = target, source
            offset = _offset(x, y)
            squared = dot(offset, offset)
            cosine = jnp.maximum(dot(normals, facing), 0)
            weight = areas * cosine * cosine * jnp.exp(-0.5 * squared / spread)

            def total(plane):
                return jnp.sum(weight * plane, axis=1)

            rows = list(rows)
            products = [axis * row for row in rows for axis in offset]
            return [jnp.sum(weight, axis=1), *map(total, (squared, *offset, *rows, *products))]

        sources = self.centers, self.normals, self.areas, rows
        sums = self.hierarchy.near.reduce(moments, (self.centers, self.normals), sources)
        total, squared, center = sums[0], sums[1], sums[2:5]
        means, products = sums[5 : 5 + len(rows)], sums[5 + len(rows) :].reshape(len(rows), 3, -1)
        inverse = 1 / jnp.where(total > 0, total, 1.0)
        # Twice the variance along the surface.
        variance = squared - dot(center, center) * inverse
        scale = jnp.where(variance > 0, 2 / jnp.where(variance > 0, variance, 1.0), 0.0)
        slopes = scale[None, None] * (products - center[None] * (means * inverse[None])[:, None])
        normals = self.normals[None]
        return slopes - jnp.sum(slopes * normals, axis=1, keepdims=True) * normals


def _offset(x, y):
    """Compute the components of `y - x` of all pairs, each a plane."""
    return [b - a for a, b in zip(x, y, strict=True)]


def _second_moments(moments, offset):
    """Contract half the second moments with the identity, and with the offset twice."""
    xx, yy, zz, xy, xz, yz = moments
    x, y, z = offset
    along = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
    return xx + yy + zz, along


def dot(a, b):
    """Multiply vectors whose components are planes."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return a_x * b_x + a_y * b_y + a_z * b_z
