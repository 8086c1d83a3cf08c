"""Residuals as a function of coefficients, computed from layers that serve many materials."""

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax.diffusion import resolved_fraction
from splatjax.fitting import AbstractModel, AbstractWeights, GivenVariances, fit_gaussians
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.render import (
    DiffusionBasis,
    Plan,
    RenderSettings,
    diffusion_basis,
    illuminate,
    make_plan,
)
from splatjax.scattering import AbstractRadialRule, Medium
from splatjax.scene import Material, Splats

from ._observation import (
    AbstractIntensity,
    AbstractLoss,
    Evidence,
    PicturedScene,
    UnknownBackground,
    check_counted,
)

_STEPS = 64
# Ratio of neighboring variances in a wide range, with which fits of dipoles have an error of 0.2%.
_LARGER = 3.0
# Range of variances, in squared mean free paths, that exceeds the range of a dipole's fit.
_NARROWEST, _WIDEST = 0.05, 200.0
# Spacing of the log variances for which plans are made. A plan is valid over a wider range.
_GRID = math.log(1.15)
# Extension of the range of variances, for starts whose coefficients are off by a factor of three.
_REACH = 10.0


def make_plans(
    pictured_scenes: Sequence[PicturedScene], material: Material, settings: RenderSettings
) -> list[Plan]:
    """Make a plan for each picture. Pictures share plans where possible, to avoid recompilation."""
    keys = [jax.tree.structure((view.camera, view.lights)) for view in pictured_scenes]
    plans = {}
    for key in dict.fromkeys(keys):
        alike = [
            view for view, own_key in zip(pictured_scenes, keys, strict=True) if own_key == key
        ]
        scenes, cameras = [view.scene(material) for view in alike], [view.camera for view in alike]
        plans[key] = make_plan(scenes, cameras, settings)
    return [plans[key] for key in keys]


def render_layers(
    pictured_scenes: Sequence[PicturedScene],
    material: Material,
    settings: RenderSettings,
    plans: list[Plan] | None = None,
    derivative: bool = True,
) -> tuple[list[DiffusionBasis], list[Plan]]:
    """Render the layers, which do not depend on weights, one picture after the other.

    **Arguments:**

    - `plans`: plans to reuse if their capacity suffices.
    - `derivative`: whether variances may differ slightly from those of the material.

    **Returns:** the pictures, and their plans.
    """

    def render(plans):
        # Keys are the plan and the lights of a picture. For three or more pictures under the same
        # lights, the light is computed once. For two, compilation would cost more than this saves.
        keys = [
            (id(plan), *(leaf.tobytes() for leaf in jax.tree.leaves(jax.device_get(view.lights))))
            for view, plan in zip(pictured_scenes, plans, strict=True)
        ]
        lights = {
            key: illuminate(view.scene(material), plan, settings, derivative)
            for key, (view, plan) in dict(
                zip(keys, zip(pictured_scenes, plans, strict=True), strict=True)
            ).items()
            if keys.count(key) > 2
        }
        return [
            jax.block_until_ready(
                diffusion_basis(
                    view.scene(material), view.camera, settings, plan, derivative, lights.get(key)
                )
            )
            for key, view, plan in zip(keys, pictured_scenes, plans, strict=True)
        ]

    pictures = render(plans) if plans else []
    if not pictures or any(float(picture.overflow) > 0 for picture in pictures):
        # Round variances to a coarse grid, so that similar materials have plans of equal shapes and
        # share a program.
        variances = jnp.round(jnp.log(material.gaussians.variances) / _GRID) * _GRID
        rounded = SumOfGaussians(jnp.exp(variances), material.gaussians.weights)
        plans = make_plans(pictured_scenes, material.surface_of(rounded), settings)
        pictures = render(plans)
    return pictures, plans or []


def wide_variances(media: Sequence[Medium], splats: Splats) -> Float[Array, " gaussians"]:
    r"""Choose variances (mm^2) that serve all media near the given ones, each three times the
    previous.

    They cover the dipoles of coefficients that differ by up to a factor of three. No Gaussian is
    much wider than the body.
    """
    paths = np.concatenate([1 / np.asarray(medium.sigma_t_prime, np.float64) for medium in media])
    root = np.concatenate([np.asarray(medium.squared_sigma_tr, np.float64) for medium in media])
    squared_diffuse = 1 / np.maximum(root, 1e-12)
    low = _NARROWEST * np.min(paths**2) / _REACH
    high = np.max(np.maximum(_WIDEST * paths**2, 3 * squared_diffuse)) * _REACH
    size = float(np.sum(np.var(np.asarray(splats.centers, np.float64), axis=0)))
    high = max(min(high, size), _LARGER * low)
    count = max(2, math.ceil(math.log(high / low) / math.log(_LARGER)) + 1)
    return jnp.asarray(low * _LARGER ** np.arange(count), media[0].sigma_a.dtype)


class Unknowns(eqx.Module):
    r"""The layout of the unknowns: log sigma_a of all channels, log sigma_s' of all channels, then
    the logarithms of the factors of the lights.

    **Attributes:**

    - `factors`: index of the factor of each channel of each picture; `count` if it is known.
    - `count`: number of factors.
    """

    eta: Float[Array, " channels"]
    factors: Int[Array, "pictures channels"]
    count: int = eqx.field(static=True)

    @classmethod
    def of(
        cls, eta: Float[Array, " channels"], intensities: Sequence[AbstractIntensity]
    ) -> "Unknowns":
        groups = np.stack([intensity.groups(len(eta)) for intensity in intensities])
        ends = np.cumsum(np.max(groups, axis=1) + 1)
        begins = np.insert(ends[:-1], 0, 0)[:, None]
        factors = np.where(groups < 0, ends[-1], groups + begins)
        return cls(eta, jnp.asarray(factors, jnp.int32), int(ends[-1]))

    def medium(self, point: Float[Array, " unknowns"]) -> Medium:
        channels = len(self.eta)
        return Medium(jnp.exp(point[:channels]), jnp.exp(point[channels : 2 * channels]), self.eta)

    def intensities(self, point: Float[Array, " unknowns"]) -> Float[Array, "pictures channels"]:
        factors = jnp.append(point[2 * len(self.eta) :], jnp.zeros((), point.dtype))
        return jnp.exp(factors[self.factors])

    def start(self, medium: Medium) -> Float[Array, " unknowns"]:
        coefficients = jnp.log(jnp.concatenate([medium.sigma_a, medium.sigma_s_prime]))
        return jnp.pad(coefficients, (0, self.count))


def fit_near(
    profile: AbstractProfile,
    near: Float[Array, " gaussians"],
    weights: AbstractWeights,
    rule: AbstractRadialRule,
) -> SumOfGaussians:
    """Fit Gaussians to a profile, starting from variances near the best ones."""
    return fit_gaussians(
        profile, len(near), weights=weights, start=GivenVariances(near), rule=rule, throw=False
    ).gaussians


class RecoveryProblem(eqx.Module):
    """Observed pictures, and a model of them as a function of coefficients.

    **Attributes:**

    - `pictures`: layers for all materials, restricted to the points in pixels that count.
    - `counted`: 1 for pixels that count, 0 for others.
    - `fit`: computes the Gaussians of a profile. Differentiable.
    """

    pictures: tuple[DiffusionBasis, ...]
    counted: tuple[Float[Array, "_ _"], ...]
    evidence: tuple[Evidence, ...]
    unknowns: Unknowns
    fit: Callable[[AbstractProfile], SumOfGaussians]
    loss: AbstractLoss
    model: AbstractModel

    @classmethod
    def of(
        cls,
        pictures: Sequence[DiffusionBasis],
        evidence: Sequence[Evidence],
        unknowns: Unknowns,
        fit: Callable[[AbstractProfile], SumOfGaussians],
        loss: AbstractLoss,
        model: AbstractModel,
    ) -> "RecoveryProblem":
        """Make the problem of rendered and observed pictures, at the pixels that the body fills."""
        dtype, background, kept, counted = unknowns.eta.dtype, UnknownBackground(), [], []
        for picture, observed in zip(pictures, evidence, strict=True):
            counted.append(observed.counted(picture.coverage.astype(dtype), background))
            is_lit = np.any(np.asarray(picture.pixel_radiance_per_exitance) > 0, axis=0)
            is_lit &= np.asarray(counted[-1]).reshape(-1)[np.asarray(picture.pixels)] > 0
            points = picture.of_points(np.flatnonzero(is_lit))
            kept.append(
                jax.tree.map(
                    lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, points
                )
            )
        check_counted(counted)
        return cls(tuple(kept), tuple(counted), tuple(evidence), unknowns, fit, loss, model)

    @property
    def pixels(self) -> int:
        """Return the number of pixels that count."""
        return int(sum(np.sum(counted) for counted in self.counted))

    def gaussians(self, point: Float[Array, " unknowns"]) -> SumOfGaussians:
        return self.fit(self.model.profile(self.unknowns.medium(point)))

    def radiance(
        self, point: Float[Array, " unknowns"]
    ) -> tuple[Float[Array, "_ _ channels"], ...]:
        gaussians, intensities = self.gaussians(point), self.unknowns.intensities(point)
        return tuple(
            intensity[None, None] * picture.beauty(gaussians)
            for intensity, picture in zip(intensities, self.pictures, strict=True)
        )

    def residuals(self, point: Float[Array, " unknowns"]) -> Float[Array, "pixels channels"]:
        together = zip(self.evidence, self.radiance(point), self.counted, strict=True)
        residuals = [observed.residuals(*rendered, self.loss) for observed, *rendered in together]
        return jnp.concatenate([rows.reshape(-1, rows.shape[-1]) for rows in residuals])


@jit_unless_traced
def search(
    problem: RecoveryProblem, start: Float[Array, " unknowns"]
) -> tuple[Float[Array, " unknowns"], Float[Array, ""], Int[Array, ""], Bool[Array, ""]]:
    """Minimize the loss from a start by the Levenberg-Marquardt method. Return the end, its loss,
    the number of steps, and whether the search converged. The final loss is finite and not larger
    than the initial loss.
    """
    tolerance = 1e-4 if start.dtype == jnp.float32 else 1e-7
    # Divide by the norm of the initial residuals, so that damping and tolerances do not depend on
    # noise and number of pixels.
    unit = jnp.sqrt(jnp.sum(problem.residuals(start) ** 2)) + jnp.finfo(start.dtype).tiny

    def residuals(point, problem):
        return problem.residuals(point) / unit

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    end = optx.least_squares(residuals, solver, start, problem, max_steps=_STEPS, throw=False)
    cost = jnp.sum(problem.residuals(end.value) ** 2)
    is_better = cost <= unit * unit
    return (
        jnp.where(is_better, end.value, start),
        jnp.where(is_better, cost, unit * unit),
        jnp.asarray(end.stats["num_steps"]),
        (end.result == optx.RESULTS.successful) & is_better,
    )


@jit_unless_traced
def solution(
    problem: RecoveryProblem, point: Float[Array, " unknowns"]
) -> tuple[
    Float[Array, "all all"],
    Float[Array, " channels"],
    SumOfGaussians,
    tuple[Float[Array, "_ _ channels"], ...],
]:
    """Compute the information of the pictures at a point: the inverse of the covariance due to
    noise (Laplace, in the Gauss-Newton approximation). The unknowns are followed by the logarithm,
    for each channel, of the width below which layers are unresolved.

    Also return the fraction of the light of each channel in unresolved layers, and the Gaussians
    and the radiance at the point.
    """

    def residuals(point, log_width):
        moved = eqx.tree_at(
            lambda tree: [picture.light.interval for picture in tree.pictures],
            problem,
            replace_fn=lambda interval: interval * jnp.exp(log_width),
        )
        return moved.residuals(point), (problem.gaussians(point), problem.radiance(point))

    (slopes, of_width), (gaussians, radiance) = jax.jacfwd(residuals, (0, 1), has_aux=True)(
        point, jnp.zeros((), point.dtype)
    )
    # Each channel has its own width.
    of_widths = of_width[..., None] * jnp.eye(of_width.shape[1], dtype=of_width.dtype)[None]
    slopes = jnp.concatenate([slopes, of_widths], axis=-1)
    light = problem.pictures[0].light
    areas = jnp.concatenate([picture.light.area for picture in problem.pictures])
    mass = jnp.concatenate([picture.light.mass for picture in problem.pictures], axis=1)
    resolved = resolved_fraction(light.variances[:, None], areas[None], light.interval)
    unresolved = 1 - jnp.mean(jnp.where(mass > 0, resolved, 0.0), axis=1)
    unresolved = unresolved @ gaussians.weights / gaussians.total_reflectance()
    return jnp.einsum("pci,pcj->ij", slopes, slopes), unresolved, gaussians, radiance
