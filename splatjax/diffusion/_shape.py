"""The diffusion equation in a body, as an integral equation over its splats."""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import take_points
from splatjax._records import record, valid
from splatjax.scattering import Medium
from splatjax.scene import Material, Splats

from ._coefficients import DiffusionCoefficients
from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Beams,
    Diffused,
    LayerValues,
)
from ._hierarchy import SIZES, Hierarchy, padded
from ._rays import SolvedLight, radiance_towards, scattered_once
from ._screened_kernel import SOFTENED, ScreenedKernel
from ._surface_sums import SurfaceSums

_SOFTENING = 2**-0.25  # softening length over the spacing
_FINER = 2**-0.5  # softening length of the sources over the length on the surface
_LEAST_KAPPA = 1e-3  # least kappa, times the root of the area
_OPEN = 0.05  # sum of the normals, by area, over the area: an open neck leaves 0.08
_MOST = 24  # largest number of matrix products of the solver


@record
class ShapeDiffuser(AbstractDiffuser):
    r"""Solves the diffusion equation in the body that closed splats bound; the other diffusers
    apply the profile of a flat half space to its surface. With the fluence `phi`, `G = exp(-kappa
    r) / (4 pi r)`, kappa the decay rate of light transport, and `D = sigma_a / kappa^2`, about `1 /
    (3 sigma_t')`, for every point x of the surface

        share(x) phi + int (G / z_e + dG/dn_y) phi dA = (1 / D) int G Q dV,    M = D phi / z_e

    - `share` is the fraction of the solid angle around x that lies in the body: 1/2 where the
      surface is smooth. It is computed from the splats, so that a constant fluence solves the
      equation for `kappa = 0` without source and escape.
    - `z_e = 0.7104 (1 + 3 C2) / (1 - 2 C1) / sigma_s'`, with the moments of the internal
      reflectance (`AbstractFresnel`).
    - Q is light scattered once along the beams, each as long as its path through the body. A part
      of it leaves before it diffuses, at either end: the difference of Hopf's function from its
      limit. With absorption another part is absorbed before it diffuses.
    - Light `J` that enters again after a bounce is uniform, so the fluence and its slope on the
      surface are `phi + z_e dphi/dn = 4 J / (1 - 2 C1)`.

    The material needs a `Medium`; its Gaussians and single scattering are not used. The splats
    should be spread evenly, at most about a mean free path apart. The time is proportional to their
    number: 0.1 ms of processor time for each and three channels.

    **Attributes:**

    - `error`: residual of the linear equations divided by their right side, root mean squares.
      Static.
    - `opening`: largest radius of the clusters of far splats, divided by their distance. The error
      of exitance is 3e-3 on a sphere and 5e-3 on slabs, which transmit up to 2% too little. With
      0 nothing is merged, for reference. Static.

    **Source:** Case and Zweifel 1967, "Linear Transport Theory" (Milne problem); Zhu, Pine and
    Weitz 1991, "Internal reflection of diffusive light in random media" (`z_e`).
    """

    error: float = eqx.field(static=True, default=1e-4, metadata=valid("positive", lambda x: x > 0))
    opening: float = eqx.field(
        static=True,
        default=0.5,
        metadata=valid("between 0 and 1", lambda x: (x >= 0) & (x <= 1)),
    )

    def radiant_exitance(
        self,
        splats: Splats,
        medium: Medium | None,
        beams: Beams,
        hierarchy: Hierarchy,
        bounced: Float[Array, "channels splats"] | None = None,
    ) -> Float[Array, "channels splats"]:
        """Solve for the light that leaves every splat, in the unit of the irradiance; light that
        crosses the body without scattering is omitted. Differentiable in everything; the exit of a
        beam is discontinuous.

        **Arguments:**

        - `hierarchy`: near splats and clusters, from `find_hierarchy`.
        - `bounced`: irradiance of uniform light that enters beside the beams.
        """
        surface, count = SurfaceSums.of(splats, hierarchy), splats.count
        beams, bounced = padded((beams, bounced))
        coefficients, area = DiffusionCoefficients.of(medium), jnp.sum(surface.areas)
        spread = jnp.sqrt(jnp.sum(surface.areas**2) / area)
        # Without absorption, kappa is small instead of 0; the error is of the order of its square.
        kappa = jnp.sqrt(coefficients.squared_kappa + _LEAST_KAPPA**2 / area)
        kernel = ScreenedKernel(kappa, _SOFTENING * spread)
        finer = ScreenedKernel(kappa, _FINER * kernel.length)
        source, leaving = scattered_once(surface, coefficients, finer, beams)

        exists = (surface.areas > 0)[None]
        ones, z_e = jnp.ones_like(surface.areas)[None], coefficients.z_e
        zero = jnp.zeros(1, z_e.dtype)
        share = -surface.layer_potentials(ScreenedKernel(zero, kernel.length), zero, ones)
        # The part that softening removes uses phi of its own splat.
        unseen = kernel.plane_integral(jnp.zeros_like(z_e)[:, None])
        diagonal = jnp.where(exists, share + unseen / z_e[:, None], 1.0)

        def product(phi):
            return phi + surface.layer_potentials(kernel, 1 / z_e, phi) / diagonal

        flux = (coefficients.diffusion_coefficient / z_e)[:, None]
        if bounced is not None:
            leaving = leaving + (1 - flux * coefficients.inward[:, None]) * bounced
            inward = (coefficients.inward / z_e)[:, None] * bounced
            single_layer = surface.layer_potentials(kernel, jnp.ones_like(z_e), inward, dipole=0.0)
            source = source + single_layer + unseen * inward
        right = jnp.where(exists, source / diagonal, 0.0)
        return (flux * solve(product, right, self.error) + leaving)[:, :count]

    def find_hierarchy(self, splats: Splats) -> Hierarchy:
        """Check that the splats bound a body, and choose near splats and clusters. Not for traced
        arrays.

        **Arguments:**

        - `splats`: in any order; a compact order, such as that of a plan, is faster.

        **Raises:** `ValueError` for splats without area, for open bodies, and for normals that
        point inward.
        """
        centers, normals, areas = (
            np.asarray(field, np.float64)
            for field in (splats.centers, splats.normals, splats.areas)
        )
        area = areas.sum()
        if not area > 0:
            raise ValueError(
                f"the areas of {len(areas)} splats sum to {area}; ShapeDiffuser needs a closed body"
            )
        open_part = np.linalg.norm(areas @ normals) / area
        if open_part > _OPEN:
            raise ValueError(
                f"the normals of the splats, weighted by area, sum to {open_part:.2g} of the "
                "area instead of 0, so the body is open; close the mesh for ShapeDiffuser, or "
                "render with ClusterDiffuser"
            )
        middle = areas @ centers / area
        volume = areas @ np.sum(normals * (centers - middle), axis=1) / 3
        if volume <= 0:
            raise ValueError(
                f"the normals of the splats bound a volume of {volume:.3g} mm^3; turn them around"
            )
        more = -len(areas) % SIZES[-1]
        exists = np.pad(areas > 0, (0, more))
        least = SOFTENED * _SOFTENING * np.sqrt(np.sum(areas**2) / area)
        return Hierarchy.build(np.pad(centers, ((0, more), (0, 0))), exists, self.opening, least)

    def make_plan(self, splats, variances, kernel, interval, devices=1):
        if devices > 1:
            raise ValueError(
                f"ShapeDiffuser works on one device, not on {devices}; make the plan without a "
                "mesh, or render with ClusterDiffuser"
            )
        return ShapePlan(jnp.zeros(1, jnp.int32), self, self.find_hierarchy(splats))


class ShapePlan(AbstractDiffusionPlan):
    """The plan for solving in one body. The solved light is one layer, of weight 1.

    **Attributes:**

    - `hierarchy`: near splats, and clusters of far ones.
    """

    diffuser: ShapeDiffuser
    hierarchy: Hierarchy
    separate = False

    def material(self, material: Material) -> Material:
        """Return the material, whose surface and coefficients are read.

        **Raises:** `ValueError` for a material without coefficients, or whose coefficients have
        another number of channels.
        """
        if material.medium is None or material.medium.channels != material.channels:
            raise ValueError(
                f"Material.medium is {material.medium}, and ShapeDiffuser needs a Medium of "
                f"{material.channels} channels; give one, or render with ClusterDiffuser"
            )
        return dataclasses.replace(material.surface_of(material.gaussians), medium=material.medium)

    def light(self, splats, material, source, beams, kernel, combination, at=None, bounced=None):
        light = beams()
        exitance = self.diffuser.radiant_exitance(
            splats, material.medium, light, self.hierarchy, bounced
        )
        surface = SurfaceSums.of(splats, self.hierarchy)
        solved = SolvedLight.of(surface, material, *padded((exitance, light, bounced)))
        slopes = solved.slopes[..., : splats.count]
        layers = LayerValues(take_points(exitance[None], at), take_points(slopes[None], at))
        return Diffused(layers, jnp.zeros_like(exitance[0, 0])), solved

    def towards(self, eye, splats, material, layers, solved, at):
        """Replace the radiant exitance of splats by the exitance of a Lambertian surface that has
        their radiance towards the eye.
        """
        surface = SurfaceSums.of(splats, self.hierarchy)
        seen = jnp.zeros(splats.count, bool).at[at].set(True, mode="drop")
        radiance = radiance_towards(eye, surface, material, solved, padded(seen))
        return LayerValues(take_points(radiance, at)[None], layers.slopes)


def solve(
    product: Callable, right: Float[Array, "systems unknowns"], error: float
) -> Float[Array, "systems unknowns"]:
    """Solve independent systems of linear equations, by generalized conjugate residuals, until
    every residual is at most `error` times the right side, root mean squares compared.
    Differentiable by the implicit function theorem.

    **Returns:** the unknowns; NaN in a system that 24 products do not solve.

    **Source:** Eisenstat, Elman and Schultz 1983, "Variational Iterative Methods for Nonsymmetric
    Systems of Linear Equations"; the iterates are those of GMRES.
    """

    lengths = partial(jnp.linalg.norm, axis=1, keepdims=True)

    def iterate(product, right):
        length = lengths(right)
        length = jnp.where(length > 0, length, 1.0)
        none = jnp.zeros((_MOST, *right.shape), right.dtype)

        def step(state):
            count, solution, residual, directions, images = state
            direction, image = residual, product(residual)
            # Orthogonalize the image against all before; twice, because rounding leaves a part.
            for _ in range(2):
                along = jnp.einsum("msu,su->ms", images, image)
                image = image - jnp.einsum("ms,msu->su", along, images)
                direction = direction - jnp.einsum("ms,msu->su", along, directions)
            size = lengths(image)
            inverse = 1 / jnp.where(size > 0, size, 1.0)
            direction, image = inverse * direction, inverse * image
            share = jnp.sum(residual * image, axis=1, keepdims=True)
            solution, residual = solution + share * direction, residual - share * image
            directions, images = directions.at[count].set(direction), images.at[count].set(image)
            return count + 1, solution, residual, directions, images

        def is_unsolved(state):
            return (state[0] < _MOST) & (jnp.max(lengths(state[2])) > error)

        start = jnp.int32(0), none[0], right / length, none, none
        _, solution, residual, *_ = jax.lax.while_loop(is_unsolved, step, start)
        return length * jnp.where(lengths(residual) <= error, solution, jnp.nan)

    return jax.lax.custom_linear_solve(product, right, iterate, iterate)
