"""The radiant exitance of the splats in place of their layers: fewer rows to blend."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import take_points

from ._clustered import ClusterDiffuser
from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    LayerValues,
    Sources,
)
from ._points import LayersAtPoints
from ._shape import ShapeDiffuser


class ExitanceDiffuser(AbstractDiffuser):
    r"""Sums the weighted layers of another diffuser at the splats, so that passes 2 and 3 blend
    one radiant exitance with its slopes, instead of means, mass and slopes for each layer. A frame
    takes three quarters of the time, and each further frame of an orbit half.

    Each splat has one gain of the kernel, also along its slopes. The picture hardly differs inside;
    along outlines it differs by a few percent where pixels are wider than splats. `Frame.layers`
    has the sum alone, with a weight of 1, and `Frame.unresolved_fraction` is 0. Derivatives by
    Gaussians (`diffusion_basis`, `picture_jacobian`) need separate layers.

    **Attributes:**

    - `layers`: the diffuser of the layers, one for each Gaussian.
    """

    layers: AbstractDiffuser = ClusterDiffuser()

    def __check_init__(self):
        if isinstance(self.layers, ShapeDiffuser | ExitanceDiffuser):
            raise ValueError(
                f"ExitanceDiffuser.layers is a {type(self.layers).__name__}, which has no layers "
                "to sum; use it directly, or give ClusterDiffuser()"
            )

    def make_plan(self, splats, variances, kernel, interval, devices=1):
        plan = self.layers.make_plan(splats, variances, kernel, interval, devices)
        return ExitancePlan.of(plan, interval)


class ExitancePlan(AbstractDiffusionPlan):
    """The plan for summing layers. The sum is one layer, of weight 1.

    **Attributes:**

    - `layers`: the plan of the layers.
    - `interval`: standard deviations per spacing between which a layer becomes resolved.
    """

    layers: AbstractDiffusionPlan
    interval: Float[Array, "2"]
    separate = False

    @classmethod
    def of(cls, plan: AbstractDiffusionPlan, interval: Float[Array, "2"]) -> AbstractDiffusionPlan:
        """Sum the layers of a plan, if it has several."""
        return cls(jnp.zeros(1, jnp.int32), plan, interval) if plan.separate else plan

    def shares(self):
        return self.layers.shares()

    def light(self, splats, material, source, beams, kernel, combination, at=None, bounced=None):
        diffused, _ = self.layers.light(
            splats, material, source, beams, kernel, combination, at, bounced
        )
        factors = Sources.of(splats, source).weights
        albedo = jnp.ones_like(source) if splats.albedo is None else splats.albedo.T
        along_splats = jax.tree.map(
            lambda rows: take_points(rows, at), (source, splats.areas, albedo, factors)
        )

        @jax.checkpoint
        def exitance(layers: LayerValues, source, area, albedo, factors) -> LayerValues:
            offset, of_means = LayersAtPoints.of(
                material.gaussians.variances,
                self.layers.gaussians,
                layers.values,
                None,
                source,
                jnp.where(area > 0, area, 1.0),
                albedo,
                self.interval,
                kernel,
                factors,
            ).linear_in_means(material.gaussians, material.single_scattering_albedo())
            of_means = of_means.at[self.layers.gaussians].get(mode="fill", fill_value=0)
            means, slopes = layers.values[:, :-1], layers.slopes[:, :-1]
            total = offset + jnp.sum(of_means * means, axis=0)
            return LayerValues(total[None], jnp.sum(of_means[:, :, None] * slopes, axis=0)[None])

        return Diffused(exitance(diffused.layers, *along_splats), diffused.needed), None
