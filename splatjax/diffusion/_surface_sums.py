"""Layer potentials on the surface of a body, and paths through it: sums over all its splats."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats

from ._hierarchy import SIZES, Hierarchy, Planes, cluster_totals, padded_count
from ._screened import ScreenedKernel

GRAZING = 1e-3  # cosine
_OVERLAP = 1.5  # radius of a splat over the root of its area
_AXES = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)  # of second moments


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
        totals, dipoles = [], []
        for charge, strength in zip(charges, powers, strict=True):
            total = charge * cluster_totals(strength)
            totals.append(total)
            dipoles.append(
                tuple(
                    cluster_totals(strength * (charge * x + n)) - total * center
                    for x, n, center in zip(self.centers, facing, centers, strict=True)
                )
            )
        given = powers, facing, self.centers
        nearby = self.hierarchy.near.reduce(near, self.centers, given)
        beyond = self.hierarchy.far.reduce(far, self.centers, (totals, dipoles, centers, moments))
        return jnp.stack(nearby) + jnp.stack(beyond)

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
        return self.hierarchy.near.reduce(
            near, self.centers, (charges, places)
        ) + self.hierarchy.far.reduce(far, self.centers, merged)

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
        rays = self.centers, directions

        def over(function, rays, given, *combine):
            parts = zip((self.hierarchy.near, self.hierarchy.far), given, strict=True)
            return [part.reduce(function, rays, sources, *combine) for part, sources in parts]

        start = jax.lax.stop_gradient(jnp.minimum(*over(first, rays, discs, jax.ops.segment_min)))
        given = tuple(zip(discs, (list(rows), means), strict=True))
        weight, *sums = jax.tree.map(jnp.add, *over(blend, (*rays, start), given))
        is_hit = starts & (weight > 0)
        length, cosine, *read = (row / jnp.where(is_hit, weight, 1.0) for row in sums)
        length = jnp.where(is_hit, length, jnp.where(starts, jnp.inf, 0.0))
        return length, cosine, read

    def slopes(self, rows: Float[Array, "rows splats"]) -> Float[Array, "rows 3 splats"]:
        """Fit the slopes of rows along the surface, 1/mm, over about two spacings."""
        spread = jnp.sum(self.areas**2) / jnp.sum(self.areas)

        def moments(here, there):
            (x, normals), (y, facing, areas, rows) = here, there
            offset = _offset(x, y)
            squared = dot(offset, offset)
            cosine = jnp.maximum(dot(normals, facing), 0)
            weight = areas * cosine * cosine * jnp.exp(-0.5 * squared / spread)

            def total(plane):
                return jnp.sum(weight * plane, axis=1)

            sums = jnp.sum(weight, axis=1), [total(axis) for axis in offset], total(squared)
            products = [[total(axis * row) for axis in offset] for row in rows]
            return *sums, [total(row) for row in rows], products

        given = self.centers, self.normals, self.areas, jnp.unstack(rows)
        total, center, squared, means, products = self.hierarchy.near.reduce(
            moments, (self.centers, self.normals), given
        )
        inverse = 1 / jnp.where(total > 0, total, 1.0)
        # Twice the variance along the surface.
        variance = squared - dot(center, center) * inverse
        scale = jnp.where(variance > 0, 2 / jnp.where(variance > 0, variance, 1.0), 0.0)
        slopes = []
        for mean, product in zip(means, products, strict=True):
            slope = [scale * (p - c * mean * inverse) for p, c in zip(product, center, strict=True)]
            across = dot(slope, self.normals)
            slopes.append([s - across * n for s, n in zip(slope, self.normals, strict=True)])
        return jnp.asarray(slopes)


def _offset(x, y):
    """Compute the components of `y - x` of all pairs, each a plane."""
    return [there - here for here, there in zip(x, y, strict=True)]


def _second_moments(moments, offset):
    """Contract half the second moments with the identity, and with the offset twice."""
    xx, yy, zz, xy, xz, yz = moments
    x, y, z = offset
    along = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
    return xx + yy + zz, along


def clusters(
    centers: Planes, weights: Float[Array, " splats"]
) -> tuple[Planes, list[Float[Array, " clusters"]]]:
    """Compute weighted centers of the clusters of all levels, and half their second moments."""

    def of_level(size):
        mass = weights.reshape(-1, size)
        total = jnp.sum(mass, axis=1, keepdims=True)
        mass = mass / jnp.where(total > 0, total, 1.0)
        members = [axis.reshape(-1, size) for axis in centers]
        means = [jnp.sum(mass * axis, axis=1) for axis in members]
        offsets = [axis - mean[:, None] for axis, mean in zip(members, means, strict=True)]
        return means, [0.5 * jnp.sum(mass * offsets[i] * offsets[j], axis=1) for i, j in _AXES]

    means, moments = jax.tree.map(
        lambda *levels: jnp.concatenate(levels), *map(of_level, SIZES[1:])
    )
    return tuple(means), moments


def dot(one, other):
    """Multiply vectors whose components are planes."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
