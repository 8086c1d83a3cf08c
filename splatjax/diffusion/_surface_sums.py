"""Layer potentials on the surface of a body, and paths through it: sums over all its splats."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats

from ._hierarchy import AXES, Clusters, Hierarchy, cluster_totals, padded
from ._screened_kernel import ScreenedKernel

GRAZING = 1e-3  # cosine
_OVERLAP = 1.5  # radius of a splat over the root of its area


class SurfaceSums(eqx.Module):
    """The splats of a body as planes, padded, and their near splats and clusters.

    **Attributes:**

    - `clusters`: weighted by area.
    - `bends`: of the clusters, the means of normal times offset from the center, mm: xx, yy, zz,
      xy, xz, yz, symmetric. The dipoles of two opposite faces cancel; this moment remains.
    """

    hierarchy: Hierarchy
    centers: Float[Array, "3 splats"]
    normals: Float[Array, "3 splats"]
    areas: Float[Array, " splats"]
    clusters: Clusters
    bends: Float[Array, "6 clusters"]

    @classmethod
    def of(cls, splats: Splats, hierarchy: Hierarchy) -> "SurfaceSums":
        if splats.weights is not None:
            raise ValueError(
                "splats.weights has factors on Gaussians, which ShapeDiffuser does not read; give "
                "weights=None, or render with ClusterDiffuser"
            )
        centers, normals, areas = padded((splats.centers.T, splats.normals.T, splats.areas))
        clusters, facing = Clusters.of(centers, areas), areas[None] * normals

        def product(i: int, j: int):
            about_origin = cluster_totals(facing[i] * centers[j])
            return about_origin - cluster_totals(facing[i]) * clusters.centers[j]

        bends = jnp.stack([0.5 * (product(i, j) + product(j, i)) for i, j in AXES])
        bends = bends / jnp.where(clusters.totals > 0, clusters.totals, 1.0)[None]
        return cls(hierarchy, centers, normals, areas, clusters, bends)

    def layer_potentials(
        self,
        kernel: ScreenedKernel,
        charges: Float[Array, " channels"],
        strengths: Float[Array, "channels splats"],
        dipole: float = 1.0,
    ) -> Float[Array, "channels splats"]:
        """Compute `int (c G + d dG/dn_y) f dA`: c are `charges`, one of each channel, 1/mm; d is
        `dipole`, and f are `strengths`.
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
            powers, dipoles, y, moments, bends = sources
            offset = _offset(x, y)
            trace, along = _second_moments(moments, offset)
            bent_trace, bent_along = _second_moments(bends, offset)
            return [
                jnp.sum(
                    power
                    * (
                        charge * value
                        + (charge * along + dipole * bent_along) * twice
                        - (charge * trace + dipole * bent_trace) * once
                    )
                    - dot(offset, directed) * once,
                    axis=1,
                )
                for charge, power, directed, (value, once, twice) in zip(
                    charges, powers, dipoles, kernel.far(dot(offset, offset)), strict=True
                )
            ]

        centers, moments = self.clusters.centers, self.clusters.moments
        totals = cluster_totals(powers)
        about_origin = powers[:, None] * (
            charges[:, None, None] * self.centers[None] + facing[None]
        )
        dipoles = cluster_totals(about_origin)
        dipoles = dipoles - (charges[:, None] * totals)[:, None] * centers[None]
        clusters = totals, dipoles, centers, moments, self.bends
        inputs = (powers, facing, self.centers), clusters
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
            # In thin parts light may scatter nearer to the far side than its splats are. The trace,
            # added to the squared distance, keeps the sums finite and positive.
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
    """Contract second moments with the identity, and with the offset twice."""
    xx, yy, zz, xy, xz, yz = moments
    x, y, z = offset
    along = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
    return xx + yy + zz, along


def dot(a, b):
    """Multiply vectors whose components are planes."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return a_x * b_x + a_y * b_y + a_z * b_z
