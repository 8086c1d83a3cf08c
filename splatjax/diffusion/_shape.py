"""The diffusion equation on the body itself, as an integral equation over its splats."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import map_chunks, take_points
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import ExactFresnel, Medium
from splatjax.scene import Material, Splats

from ._diffuser import AbstractDiffuser, AbstractDiffusionPlan, Diffused, LayerValues
from ._screened import ScreenedKernel

_AT_ONCE = 64  # points
_FINER = 2  # octaves: the light in the body varies faster than that on its surface
_WIDE = 1e12  # mm^2: resolved everywhere
_DEPTHS = 8  # along each beam
_OVERLAP = 1.5  # radius of a splat over the root of its area
_GRAZING = 1e-3  # cosine
_OPEN = 0.03  # sum of the normals, by area, over the area: sampled closed bodies stay below 0.01
_MILNE = 0.710446  # extrapolation distance of the Milne problem, mean free paths
# Hopf's q(tau) = _MILNE - sum_i a_i exp(-b_i tau), within 0.0024.
_HOPF = (0.08948, 2.11533), (0.04361, 16.63774)


class Beams(eqx.Module):
    """Light that enters a body, one beam for each splat: of many lights their sum, with the mean
    of their directions.

    **Attributes:** (differentiable)

    - `irradiance`: that enters, after the loss at the surface.
    - `directions`: in which it travels inside, by which the place of its first scattering moves
      per mean free path: unit for one light, shorter for several.
    """

    irradiance: Float[Array, "channels splats"]
    directions: Float[Array, "channels 3 splats"]


class ShapeDiffuser(AbstractDiffuser):
    r"""Solves the diffusion equation in the body that closed splats bound, where the other
    diffusers lay the profile of a flat half-space over its surface. With the fluence `phi`,
    `G = exp(-kappa r) / (4 pi r)`, `D = 1 / (3 sigma_t')` and `kappa^2 = sigma_a / D`, for every
    point x of the surface

        share(x) phi + int (G / z_e + dG/dn_y) phi dA = (1 / D) int G Q dV,    M = D phi / z_e

    - `share` is 1/2 where the surface is smooth and the solid angle's share of the body at creases:
      the sum of the same splats for `kappa = 0` over a constant.
    - `z_e = 0.7104 (1 + 3 C2) / (1 - 2 C1) / sigma_t'`, of the internal reflectance.
    - Q is light scattered once along the beams, each as long as its way through the body. A part of
      it leaves before it diffuses: that by which Hopf's function falls short of its limit.

    The surface is to be resolved: the spacing of the splats at most about the mean free path. Time
    grows with the square of their number.

    **Attributes:**

    - `error`: of the solution of the linear equations, relative.

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
        """
        count = self.count_gaussians(splats) if count is None else count
        spread = jnp.sqrt(jnp.sum(splats.areas**2) / jnp.sum(splats.areas))
        share = map_chunks(_share(splats, spread, count), splats.centers, at_once=_AT_ONCE)

        def of_channel(channel):
            medium, irradiance, directions = channel
            return self._solve(splats, medium, irradiance, directions, spread, share, count)

        directions = jnp.swapaxes(beams.directions, 1, 2)
        return jax.lax.map(of_channel, (_coefficients(medium), beams.irradiance, directions))

    def make_plan(self, parts, variances, kernel, interval):
        if len(parts) > 1:
            raise ValueError(
                f"ShapeDiffuser works on one device, not on {len(parts)}; make the plan without a "
                "mesh, or render with ClusterDiffuser"
            )
        return ShapePlan(jnp.zeros(1, jnp.int32), self, self.count_gaussians(parts[0]))

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
            raise ValueError("the areas of the splats sum to 0; ShapeDiffuser needs a closed body")
        opening = np.linalg.norm(areas @ normals) / area
        if opening > _OPEN:
            raise ValueError(
                f"the normals of the splats, weighted by area, sum to {opening:.2g} of the area, "
                "and those of a closed body to 0; close the mesh for ShapeDiffuser, or render with "
                "ClusterDiffuser"
            )
        volume = areas @ np.sum(normals * (centers - centers.mean(axis=0)), axis=1) / 3
        if volume <= 0:
            raise ValueError(
                f"the normals of the splats bound a volume of {volume:.3g} mm^3; turn them around"
            )
        reach = float(np.linalg.norm(np.ptp(centers[areas > 0], axis=0)))
        return ScreenedKernel.count_for(reach, float(np.sqrt(areas.mean())))

    def _solve(self, splats, medium, irradiance, directions, spread, share, count):
        kernel = ScreenedKernel(medium.squared_kappa, spread, count)
        source, leaving = _scattered_once(splats, medium, kernel.finer(_FINER), irradiance, directions)
        diagonal = share + kernel.plane_integral(jnp.zeros_like(spread)) / medium.z_e

        def product(phi):
            strength = splats.areas * phi

            def at(x):
                value, slope, across = _pairs(kernel, x, splats)
                return (value / medium.z_e - slope * across) @ strength

            return phi + map_chunks(at, splats.centers, at_once=_AT_ONCE) / diagonal

        right = source / diagonal
        operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: right))
        # Five products reach about 1e-3; the second five show it.
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(right)))
        smallest = jnp.finfo(right.dtype).tiny
        solver = lx.GMRES(rtol=self.error, atol=self.error * size + smallest, restart=5)
        phi = lx.linear_solve(operator, right, solver).value
        return medium.diffusion_coefficient / medium.z_e * phi + leaving


class ShapePlan(AbstractDiffusionPlan):
    """What solving on one body needs. The solved light is one layer, of weight 1."""

    diffuser: ShapeDiffuser
    count: int = eqx.field(static=True)

    def material(self, material: Material) -> Material:
        """Return a material of one Gaussian of weight 1, which every splat resolves.

        **Raises:** `ValueError` for a material without coefficients, or of other channels.
        """
        if material.medium is None or material.medium.channels != material.channels:
            raise ValueError(
                f"Material.medium is {material.medium}, and ShapeDiffuser solves for a Medium of "
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
        layer = LayerValues(values[None], _slopes(splats, values)[None])
        return layer if at is None else jax.tree.map(lambda row: take_points(row, at), layer)

    def towards(
        self,
        eye: Float[Array, "3"],
        splats: Splats,
        material: Material,
        layer: LayerValues,
        beams: Beams,
    ) -> LayerValues:
        r"""Replace the radiant exitance M of splats by `pi` times the radiance towards the eye, for
        an even surface: the source integral along the refracted ray `w`,

            L = int (sigma_s' phi + Q) / (4 pi) exp(-sigma_t' s) ds = f M / pi
                - (sigma_s' / sigma_t'^2) w . grad_t phi / (4 pi)

        `f`, 1 on average, is that of a half-space with this `phi` on its surface and these beams.
        Along the surface `phi` is linear. Light is seen from the side on which there is less of it
        as brighter, and from the lit side as darker.

        **Arguments:** `layer` and `beams` of these splats.
        """
        to_eye = eye[:, None] - splats.centers.T
        to_eye = to_eye / jnp.sqrt(jnp.sum(to_eye * to_eye, axis=0))
        cosine = jnp.maximum(jnp.sum(to_eye * splats.normals.T, axis=0), _GRAZING)
        along = (to_eye - cosine * splats.normals.T) / material.eta
        medium = _coefficients(material.medium)
        albedo, z_e = medium.albedo[:, None], medium.z_e[:, None]
        exitance, slopes = layer.values[0, :-1], layer.slopes[0, :-1]
        entering = jnp.maximum(-jnp.sum(beams.directions * splats.normals.T, axis=1), 0)
        phi = 3 * z_e * medium.sigma_t[:, None] * exitance
        bend = 3 * (1 - albedo)
        bend = bend / (1 + bend)  # below 1 for every albedo
        # Particular solution of the beams, P exp(-tau / entering); phi - P is a line from z_e.
        start = -3 * albedo * beams.irradiance / (1 - bend * entering * entering)
        level, rise = phi - start * entering, exitance * 3 + start

        def radiance(cosine):
            squared = (1 - cosine * cosine) / (material.eta * material.eta)
            mu = jnp.sqrt(jnp.maximum(1 - squared, _GRAZING))
            beam = albedo * (start * entering * entering + beams.irradiance) / (entering + mu)
            return albedo * (level + rise * mu) / (1 - bend * mu * mu) + beam

        nodes, weights = np.polynomial.legendre.leggauss(_DEPTHS)
        nodes, weights = (nodes + 1) / 2, weights / 2
        mean = sum(
            2 * w * c * radiance(jnp.full_like(cosine, c))
            for c, w in zip(nodes.tolist(), weights.tolist(), strict=True)
        )
        shape = radiance(cosine) / jnp.where(mean > 0, mean, 1.0)
        shape = jnp.where(mean > 0, jnp.clip(shape, 0, 2), 1.0)
        across = 0.75 * albedo * z_e * jnp.sum(slopes * along, axis=1)
        seen = jnp.maximum(exitance * shape - across, 0)
        return LayerValues(jnp.concatenate([seen, layer.values[0, -1:]])[None], layer.slopes)

    def diffuse(self, sources, variances, kernel, combination, at=None) -> Diffused:
        raise ValueError(
            "ShapeDiffuser solves for the light of a scene, without derivatives by Gaussians; "
            "render with ClusterDiffuser"
        )


class _Coefficients(eqx.Module):
    """Of the diffusion equation and its boundary, one for each channel."""

    sigma_t: Float[Array, "*channels"]
    albedo: Float[Array, "*channels"]
    squared_kappa: Float[Array, "*channels"]
    z_e: Float[Array, "*channels"]

    @property
    def diffusion_coefficient(self):
        return 1 / (3 * self.sigma_t)


def _coefficients(medium: Medium) -> _Coefficients:
    fresnel, sigma_t = ExactFresnel(), medium.sigma_t_prime
    boundary = (1 + fresnel.second_moment(medium.eta)) / (1 - fresnel.first_moment(medium.eta))
    z_e = _MILNE * boundary / sigma_t
    return _Coefficients(sigma_t, medium.albedo_prime, medium.squared_sigma_tr, z_e)


def _pairs(kernel: ScreenedKernel, x: Float[Array, "points 3"], splats: Splats):
    """Evaluate the kernel, its slope, and `(y - x) . n_y`, of all splats `y` at some points."""
    offset = [splats.centers[None, :, i] - x[:, None, i] for i in range(3)]
    value, slope = kernel(sum(each * each for each in offset))
    return value, slope, sum(splats.normals[None, :, i] * offset[i] for i in range(3))


def _slopes(
    splats: Splats, values: Float[Array, "rows splats"]
) -> Float[Array, "rows 3 splats"]:
    """Fit the slopes of values along the surface, 1/mm, over about two spacings."""
    spread = jnp.sum(splats.areas**2) / jnp.sum(splats.areas)
    count = len(values)

    def at(here):
        x, normals = here
        offset = [splats.centers[None, :, i] - x[:, None, i] for i in range(3)]
        facing = jnp.maximum(normals @ splats.normals.T, 0)
        squared = sum(each * each for each in offset)
        weight = splats.areas * facing * facing * jnp.exp(-0.5 * squared / spread)
        total = jnp.maximum(jnp.sum(weight, axis=1), jnp.finfo(weight.dtype).tiny)
        mean = (weight @ values.T) / total[:, None]
        moments = [weight * each for each in offset]
        centers = jnp.stack([jnp.sum(each, axis=1) for each in moments], axis=1)
        products = jnp.stack([each @ values.T for each in moments], axis=1)
        products = products - centers[:, :, None] * mean[:, None]
        centers_squared = jnp.sum(centers * centers, axis=1) / total
        variance = (jnp.sum(weight * squared, axis=1) - centers_squared) / 2
        slopes = products / jnp.where(variance > 0, variance, 1.0)[:, None, None]
        across = jnp.sum(slopes * normals[:, :, None], axis=1, keepdims=True)
        return (slopes - across * normals[:, :, None]).reshape(-1, 3 * count)

    rows = map_chunks(at, (splats.centers, splats.normals), at_once=_AT_ONCE)
    return jnp.moveaxis(rows.reshape(-1, 3, count), 0, -1).swapaxes(0, 1)


def _share(splats: Splats, spread, count: int):
    """Return the function that computes the share of the body in all directions from a point."""
    kernel = ScreenedKernel(jnp.zeros_like(spread), spread, count)

    def at(x):
        _, slope, across = _pairs(kernel, x, splats)
        return (slope * across) @ splats.areas

    return at


def _scattered_once(splats, medium, kernel, irradiance, directions):
    """Compute the right side of the equation at every splat, and the light that leaves at once."""
    u, shares = np.polynomial.legendre.leggauss(_DEPTHS)
    u, shares = (jnp.asarray(each / 2, irradiance.dtype) for each in (u + 1, shares))
    length = beam_lengths(splats, directions, irradiance > 0)
    stopped = -jnp.expm1(-medium.sigma_t * length)
    along = -jnp.log1p(-u[:, None] * stopped) / medium.sigma_t
    scattered = shares[:, None] * stopped * medium.albedo * irradiance
    depth = along * -jnp.sum(directions * splats.normals, axis=-1)
    early = _leaves_early(depth * medium.sigma_t, medium)
    leaving, scattered = jnp.sum(early * scattered, axis=0), (1 - early) * scattered
    places = splats.centers + along[:, :, None] * directions
    strength = splats.areas * scattered

    def at(x):
        def add(total, plane):
            q, strength = plane
            offset = [q[None, :, i] - x[:, None, i] for i in range(3)]
            return total + kernel(sum(each * each for each in offset))[0] @ strength, None

        return jax.lax.scan(jax.checkpoint(add), jnp.zeros_like(x[:, 0]), (places, strength))[0]

    total = map_chunks(at, splats.centers, at_once=_AT_ONCE)
    total = total + jnp.sum(scattered * kernel.plane_integral(depth), axis=0)
    return total / medium.diffusion_coefficient, leaving


def _leaves_early(tau: Float[Array, "*points"], medium: _Coefficients) -> Float[Array, "*points"]:
    """Compute the fraction of light first scattered at optical depth `tau` that leaves before it
    diffuses: seen from deep below, an isotropic source shines as `tau + q(tau)`, and diffuses as
    `tau + q(inf)`. Where light is absorbed, less of it, as the Bond albedo of a half-space has it.
    """
    lost = jnp.sqrt(jnp.maximum(1 - medium.albedo, 1e-12))
    held = 1 - 6 * lost / (1 + 1.4 * lost + 2.6 * lost * lost)
    short = sum(a * jnp.exp(-b * tau) for a, b in _HOPF)
    return held * short / (tau + medium.z_e * medium.sigma_t)


def beam_lengths(
    splats: Splats, directions: Float[Array, "splats 3"], is_lit: Bool[Array, " splats"]
) -> Float[Array, " splats"]:
    """Compute how far each beam goes from its splat to the first one that it leaves the body by,
    in lengths of its direction; 0 where there is none.
    """
    squared_radii = _OVERLAP**2 * splats.areas

    def at(beams):
        start, way = beams
        offset = [splats.centers[None, :, i] - start[:, None, i] for i in range(3)]
        cosine = sum(splats.normals[None, :, i] * way[:, None, i] for i in range(3))
        outward = cosine > _GRAZING
        across = sum(splats.normals[None, :, i] * offset[i] for i in range(3))
        t = across / jnp.where(outward, cosine, 1.0)
        missed = sum((offset[i] - t * way[:, None, i]) ** 2 for i in range(3))
        hit = outward & (t > 0) & (missed < squared_radii[None])
        first = jnp.min(jnp.where(hit, t, jnp.inf), axis=1, keepdims=True)
        # Blend the splats that lie there.
        near = hit & (t < first + jnp.sqrt(splats.areas)[None])
        areas = jnp.where(near, splats.areas[None], 1.0)
        weight = jnp.where(near, jnp.exp(-2 * jnp.where(near, missed, 0.0) / areas), 0.0)
        total = jnp.sum(weight, axis=1)
        return jnp.sum(weight * t, axis=1) / jnp.where(total > 0, total, 1.0)

    lengths = map_chunks(at, (splats.centers, directions), at_once=_AT_ONCE)
    return jnp.where(is_lit, lengths, 0.0)
