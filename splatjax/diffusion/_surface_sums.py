"""Layer potentials on the surface of a body, and paths through it: sums over all its splats, with
the Green's function of the diffusion equation, softened within their spacing.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from splatjax.scene import Splats

from ._hierarchy import Hierarchy, Planes, cluster_totals, clusters, padded_count

GRAZING = 1e-3  # cosine
_OVERLAP = 1.5  # radius of a splat over the root of its area
_TERMS, _SMALL = 8, 0.1  # of the series of the softening near 0
_NODES, _REACH = 12, 4.0  # of the integral of what is left out, and its end in softening lengths
_SCALE = 2 / math.sqrt(math.pi)
SOFTENED = 3.0  # softening lengths, beyond which the kernel is as without


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
        by_series, fall_by_series = jnp.zeros_like(q), jnp.zeros_like(q)
        for n in range(_TERMS, -1, -1):
            term = _SCALE * (-1) ** n / (math.factorial(n) * (2 * n + 1))
            by_series = by_series * small + term
            if n:
                fall_by_series = fall_by_series * small - 2 * n * term
        ratio = jnp.where(near, by_series, ratio)
        fall = jnp.where(near, fall_by_series, fall)
        return ratio / self.length, fall / self.length**3

    def plane_integral(self, height: Float[Array, "channels *points"]) -> Float[Array, "..."]:
        """Integrate the part that softening removes over a plane, mm.

        **Arguments:**

        - `height`: of the point over the plane, mm.
        """
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        kappa = self.kappa.reshape(-1, *[1] * (height.ndim - 1))
        end, total = _REACH * self.length, jnp.zeros_like(height)
        span = jnp.maximum(end - jnp.abs(height), 0)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            r = end - span * (1 - node) / 2
            inverse, _ = self._softening(r * r)
            left_out = jnp.exp(-kappa * r) - r * inverse * jnp.exp(-kappa / inverse)
            total = total + weight / 4 * span * left_out
        return total


class SurfaceSums(eqx.Module):
    """The splats of a body as planes, padded, and their near splats and clusters."""

    hierarchy: Hierarchy
    centers: Planes
    normals: Planes
    areas: Float[Array, " splats"]

    @classmethod
    def of(cls, splats: Splats, hierarchy: Hierarchy) -> "SurfaceSums":
        if splats.weights is not None:
            raise ValueError(
                "splats.weights has factors on Gaussians, which ShapeDiffuser does not read; give "
                "weights=None, or render with ClusterDiffuser"
            )
        more = padded_count(splats.count) - splats.count
        centers, normals = (
            tuple(jnp.pad(rows, ((0, more), (0, 0))).T) for rows in (splats.centers, splats.normals)
        )
        return cls(hierarchy, centers, normals, jnp.pad(splats.areas, (0, more)))

    def padded(self, rows: PyTree[Array]) -> PyTree[Array]:
        """Append zeros to rows along the splats, for the padding."""

        def pad(row):
            more = len(self.areas) - row.shape[-1]
            return jnp.pad(row, [(0, 0)] * (row.ndim - 1) + [(0, more)])

        return jax.tree.map(pad, rows)

    def layers(
        self,
        kernel: ScreenedKernel,
        charges: Sequence[Float[Array, ""] | float],
        strengths: Float[Array, "channels splats"],
        dipole: float = 1.0,
    ) -> Float[Array, "channels splats"]:
        """Compute `int (c G + d dG/dn_y) f dA`, of every channel with its own c, 1/mm, and d the
        strength of the dipole.
        """
        facing = tuple(dipole * axis for axis in self.normals)
        powers = jnp.unstack(self.areas[None] * strengths)

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

        centers, moments = clusters(self.centers, self.areas)
        channels = list(zip(charges, powers, strict=True))
        totals = [charge * cluster_totals(power) for charge, power in channels]
        dipoles = [
            tuple(
                cluster_totals(power * (charge * x + n)) - total * center
                for x, n, center in zip(self.centers, facing, centers, strict=True)
            )
            for (charge, power), total in zip(channels, totals, strict=True)
        ]
        inputs = (powers, facing, self.centers), (totals, dipoles, centers, moments)
        return jnp.stack(self.hierarchy.sum(near, far, self.centers, *inputs))

    def potential(
        self, kernel: ScreenedKernel, charges: Float[Array, " splats"], places: Planes
    ) -> Float[Array, " splats"]:
        """Compute `sum_j q_j G` of charges below the splats, for a kernel of one channel, 1/mm.

        **Arguments:**

        - `places`: of the charges, mm.
        """

        def near(x, sources):
            charges, y = sources
            offset = _offset(x, y)
            ((value, _),) = kernel.near(dot(offset, offset))
            return jnp.sum(charges * value, axis=1)

        def far(x, sources):
            totals, y, moments = sources
            offset = _offset(x, y)
            trace, along = _second_moments(moments, offset)
            # In thin parts light scatters nearer to the far side than its splats are: the trace,
            # added to the squared distance, keeps sums finite and positive.
            ((value, _, twice),) = kernel.far(dot(offset, offset) + 2 * trace)
            return jnp.sum(totals * (value + along * twice), axis=1)

        merged = cluster_totals(charges), *clusters(places, charges)
        return self.hierarchy.sum(near, far, self.centers, (charges, places), merged)

    def first_exits(
        self,
        directions: Planes,
        starts: Bool[Array, " splats"],
        rows: Sequence[Float[Array, " splats"]] = (),
    ) -> tuple[Float[Array, " splats"], Float[Array, " splats"], list[Float[Array, " splats"]]]:
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
            return jnp.min(jnp.where(is_hit, t, jnp.inf), axis=1)

        def blend(ray, discs):
            ray, first, (discs, rows) = ray[:2], ray[2], discs
            is_hit, t, missed, area, cosine = crossing(ray, discs)
            is_near = is_hit & (t < first + jnp.sqrt(area))
            weight = jnp.where(is_near, jnp.exp(-6 * jnp.where(is_near, missed, 0.0)), 0.0)
            return [jnp.sum(weight * row, axis=1) for row in (1.0, t, cosine, *rows)]

        facing = tuple(self.areas * axis for axis in self.normals)
        centers, _ = clusters(self.centers, self.areas)
        discs = (self.centers, facing), (centers, tuple(map(cluster_totals, facing)))
        total = cluster_totals(self.areas)
        means = [cluster_totals(self.areas * row) / jnp.where(total > 0, total, 1) for row in rows]
        rays, (near, far) = (self.centers, directions), (self.hierarchy.near, self.hierarchy.far)
        starting = (
            interactions.reduce(first, rays, sources, jax.ops.segment_min)
            for interactions, sources in zip((near, far), discs, strict=True)
        )
        start = jax.lax.stop_gradient(jnp.minimum(*starting))
        sources = zip(discs, (list(rows), means), strict=True)
        weight, *sums = self.hierarchy.sum(blend, blend, (*rays, start), *sources)
        is_hit = starts & (weight > 0)
        length, cosine, *read = (row / jnp.where(is_hit, weight, 1.0) for row in sums)
        length = jnp.where(is_hit, length, jnp.where(starts, jnp.inf, 0.0))
        return length, cosine, read

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

            sums = jnp.sum(weight, axis=1), [total(axis) for axis in offset], total(squared)
            products = [[total(axis * row) for axis in offset] for row in rows]
            return *sums, [total(row) for row in rows], products

        sources = self.centers, self.normals, self.areas, jnp.unstack(rows)
        total, center, squared, means, products = self.hierarchy.near.reduce(
            moments, (self.centers, self.normals), sources
        )
        inverse = 1 / jnp.where(total > 0, total, 1.0)
        # Twice the variance along the surface.
        variance = squared - dot(center, center) * inverse
        scale = jnp.where(variance > 0, 2 / jnp.where(variance > 0, variance, 1.0), 0.0)
        means, products, center, normals = map(jnp.asarray, (means, products, center, self.normals))
        slopes = scale * (products - center[None] * (means * inverse)[:, None])
        return slopes - jnp.sum(slopes * normals[None], axis=1, keepdims=True) * normals[None]


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
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
