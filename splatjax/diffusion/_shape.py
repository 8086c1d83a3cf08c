"""The diffusion equation on the body itself, as an integral equation over its splats."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax._chunking import map_chunks, take_points
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import Medium
from splatjax.scene import Material, Splats

from ._beams import AT_ONCE, Beams, DiffusionCoefficients, dot, offsets, scattered_once
from ._diffuser import AbstractDiffuser, AbstractDiffusionPlan, Diffused, LayerValues
from ._emission import radiance_towards, slopes_along_surface
from ._screened import ScreenedKernel

_FINER = 1  # octaves
_OPEN = 0.05  # sum of the normals, by area, over the area: an open neck leaves 0.08
_WIDE = 1e12  # mm^2: resolved everywhere


class ShapeDiffuser(AbstractDiffuser):
    r"""Solves the diffusion equation in the body that closed splats bound, where the other
    diffusers lay the profile of a flat half-space over its surface. With the fluence `phi`,
    `G = exp(-kappa r) / (4 pi r)`, `D = 1 / (3 sigma_t')` and `kappa^2 = sigma_a / D`, for every
    point x of the surface

        share(x) phi + int (G / z_e + dG/dn_y) phi dA = (1 / D) int G Q dV,    M = D phi / z_e

    - `share` is 1/2 where the surface is smooth and the solid angle's share of the body at creases:
      a constant solves the equation of the same splats for `kappa = 0`, without source and escape.
    - `z_e = 0.7104 (1 + 3 C2) / (1 - 2 C1) / sigma_t'`, of the internal reflectance.
    - Q is light scattered once along the beams, each as long as its way through the body. A part of
      it leaves before it diffuses: that by which Hopf's function falls short of its limit.

    The material needs a `Medium`, whose light is solved for; its Gaussians and single scattering do
    not matter. The splats should be spread evenly, and lie at most about a mean free path apart.
    Time grows with the square of their number: 8 ns per pair, channel and product in float32,
    with 12 products and the light at 8 depths.

    **Attributes:**

    - `error`: of the solution of the linear equations, over its maximum. Static.

    **Source:** Case and Zweifel 1967, "Linear Transport Theory" (Milne problem); Zhu, Pine and
    Weitz 1991, "Internal reflection of diffusive light in random media" (`z_e`).
    """

    error: float = eqx.field(static=True, default=1e-4)

    def radiant_exitance(
        self, splats: Splats, medium: Medium, beams: Beams, count: int | None = None
    ) -> Float[Array, "channels splats"]:
        """Solve for the light that leaves every splat, in the unit of the irradiance; light that
        crosses the body without scattering is left out. Differentiable in everything; which splat
        a beam leaves by is discontinuous.

        **Arguments:**

        - `count`: of Gaussians that make the kernel, from `count_gaussians`; needed under `jit`.

        **Raises:** `ValueError` as `count_gaussians`, where no count is given.
        """
        count = self.count_gaussians(splats) if count is None else count
        spread = jnp.sqrt(jnp.sum(splats.areas**2) / jnp.sum(splats.areas))
        kernel = ScreenedKernel(jnp.zeros_like(spread), spread, count)

        def body_share(x):
            _, slope, across = _pairs(kernel, x, splats)
            return (slope * across) @ splats.areas

        share = map_chunks(body_share, splats.centers, at_once=AT_ONCE)

        def of_channel(channel):
            coefficients, irradiance, directions = channel
            of_medium = dataclasses.replace(kernel, squared_kappa=coefficients.squared_kappa)
            beams = irradiance, directions.T
            return self._solve(splats, coefficients, of_medium, share, *beams)

        given = DiffusionCoefficients.of(medium), beams.irradiance, beams.directions
        return jax.lax.map(of_channel, given)

    def _solve(self, splats, medium, kernel, share, irradiance, directions):
        """Solve for one channel."""
        beams = irradiance, directions
        source, leaving = scattered_once(splats, medium, kernel.finer(_FINER), *beams)
        # Gaussians too narrow to be summed see phi as it is on their own splat.
        own = kernel.plane_integral(jnp.zeros_like(kernel.spread)) / medium.z_e
        diagonal = share + own

        def product(phi):
            strength = splats.areas * phi

            def at(x):
                value, slope, across = _pairs(kernel, x, splats)
                return (value / medium.z_e - slope * across) @ strength

            return phi + map_chunks(at, splats.centers, at_once=AT_ONCE) / diagonal

        right = source / diagonal
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(right)))
        largest = jnp.where(largest > 0, largest, 1.0)
        operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: right))
        # Five products reach about 1e-3; five more show that.
        solver = lx.GMRES(rtol=self.error, atol=self.error, restart=5)
        phi = largest * lx.linear_solve(operator, right / largest, solver).value
        return medium.diffusion_coefficient / medium.z_e * phi + leaving

    def count_gaussians(self, splats: Splats) -> int:
        """Check that the splats bound a body, and count the Gaussians. Not for traced arrays.

        **Raises:** `ValueError` for splats without area, for open bodies, and for normals that
        point inward.
        """
        centers, normals, areas = (
            np.asarray(each, np.float64) for each in (splats.centers, splats.normals, splats.areas)
        )
        area = areas.sum()
        if not area > 0:
            raise ValueError(
                f"the areas of {len(areas)} splats sum to {area}; ShapeDiffuser needs a closed body"
            )
        opening = np.linalg.norm(areas @ normals) / area
        if opening > _OPEN:
            raise ValueError(
                f"the normals of the splats, weighted by area, sum to {opening:.2g} of the area, "
                "and those of a closed body to 0; close the mesh for ShapeDiffuser, or render with "
                "ClusterDiffuser"
            )
        middle = areas @ centers / area
        volume = areas @ np.sum(normals * (centers - middle), axis=1) / 3
        if volume <= 0:
            raise ValueError(
                f"the normals of the splats bound a volume of {volume:.3g} mm^3; turn them around"
            )
        reach = float(np.linalg.norm(np.ptp(centers[areas > 0], axis=0)))
        return ScreenedKernel.count_for(reach, float(np.sqrt(areas @ areas / area)))

    def make_plan(self, parts, variances, kernel, interval):
        if len(parts) > 1:
            raise ValueError(
                f"ShapeDiffuser works on one device, not on {len(parts)}; make the plan without a "
                "mesh, or render with ClusterDiffuser"
            )
        return ShapePlan(jnp.zeros(1, jnp.int32), self, self.count_gaussians(parts[0]))


class ShapePlan(AbstractDiffusionPlan):
    """What solving on one body needs. The solved light is one layer, of weight 1.

    **Attributes:**

    - `count`: of the Gaussians that make the kernel. Static.
    """

    diffuser: ShapeDiffuser
    count: int = eqx.field(static=True)

    def material(self, material: Material) -> Material:
        """Return a material of one Gaussian of weight 1, which all splats resolve.

        **Raises:** `ValueError` for a material without coefficients, or with those of other
        channels.
        """
        if material.medium is None or material.medium.channels != material.channels:
            raise ValueError(
                f"Material.medium is {material.medium}, and ShapeDiffuser needs a Medium of "
                f"{material.channels} channels; give one, or render with ClusterDiffuser"
            )
        weights = jnp.ones_like(material.gaussians.weights[:1])
        variances = jnp.full_like(material.gaussians.variances[:1], _WIDE)
        shown = material.surface_of(SumOfGaussians(variances, weights))
        return dataclasses.replace(shown, medium=material.medium)

    def solve(
        self, splats: Splats, medium: Medium, beams: Beams, at: Int[Array, " points"] | None
    ) -> LayerValues:
        """Return the radiant exitance of some splats as a layer, with its slopes."""
        exitance = self.diffuser.radiant_exitance(splats, medium, beams, self.count)
        values = jnp.concatenate([exitance, jnp.ones_like(exitance[:1])])
        layer = LayerValues(values[None], slopes_along_surface(splats, values)[None])
        return layer if at is None else jax.tree.map(lambda row: take_points(row, at), layer)

    def towards(
        self,
        eye: Float[Array, "3"],
        splats: Splats,
        material: Material,
        layer: LayerValues,
        beams: Beams,
    ) -> LayerValues:
        """Replace the radiant exitance of splats by that of an even surface as bright as they are
        from the eye.
        """
        exitance, slopes = layer.values[0, :-1], layer.slopes[0, :-1]
        seen = radiance_towards(eye, splats, material, exitance, slopes, beams)
        values = jnp.concatenate([seen, layer.values[0, -1:]])
        return LayerValues(values[None], layer.slopes)

    def diffuse(self, sources, variances, kernel, combination, at=None) -> Diffused:
        raise ValueError(
            "ShapeDiffuser solves for the light of a scene, without derivatives by Gaussians; "
            "render with ClusterDiffuser"
        )


def _pairs(kernel: ScreenedKernel, x: Float[Array, "points 3"], splats: Splats):
    """Evaluate the kernel, its slope, and `(y - x) . n_y`, of all splats `y` at some points."""
    offset = offsets(x, splats.centers)
    value, slope = kernel(dot(offset, offset))
    return value, slope, dot(offset, [splats.normals[None, :, axis] for axis in range(3)])
