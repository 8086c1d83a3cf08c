"""The diffusion integral of the irradiance for every layer (pass 4, section 4.2)."""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._combination import AbstractCombination
from splatjax.scene import Splats

from ._kernel import AbstractDiffusionKernel


class Sources(eqx.Module):
    """The splats as sources of diffused light, or clusters that stand for several of them. An empty
    cluster has no area.

    **Attributes:**

    - `centers`, `normals`: of clusters means over the area; mean normals are shorter than one where
      the surface bends.
    - `areas`, `irradiance`: of clusters sums of the areas, mm^2, and means over them.
    """

    centers: Float[Array, "3 sources"]
    normals: Float[Array, "3 sources"]
    areas: Float[Array, " sources"]
    irradiance: Float[Array, "channels sources"]

    def lowered(self, depth: Float[Array, ""]) -> "Sources":
        """Move every source against its normal by `depth` (mm)."""
        return dataclasses.replace(self, centers=self.centers - depth * self.normals)

    def merged(self, parents: Int[Array, " sources"], count: int) -> "Sources":
        """Merge into `count` parents. Area and energy are kept. Differentiable."""

        def totals(rows: Float[Array, "rows sources"]) -> Float[Array, "rows parents"]:
            return jax.vmap(lambda row: jax.ops.segment_sum(row, parents, count))(rows)

        # Means over the area of the children.
        areas = totals(self.areas[None])[0]
        rows = jnp.concatenate([self.centers, self.normals, self.irradiance])
        means = totals(self.areas[None] * rows) / jnp.where(areas > 0, areas, 1.0)[None]
        return Sources(means[:3], means[3:6], areas, means[6:])


class LayerValues(eqx.Module):
    """One layer at some points.

    **Attributes:**

    - `values`: of each channel the weighted mean of the irradiance around, which keeps constants,
      lies between the least and the greatest irradiance, and is linear in it; and last the mass of
      the kernel on the surface, 1 on a flat sheet.
    - `slopes`: of the values in space, 1/mm.
    """

    values: Float[Array, "values points"]
    slopes: Float[Array, "values 3 points"]


class Diffused(eqx.Module):
    """The layers on the splats.

    **Attributes:**

    - `layers`: one for each Gaussian; `None` for a layer that is too narrow for nearly all splats.
    - `needed`: capacity needed over planned; above 1 the values are incomplete.
    """

    layers: tuple[LayerValues | None, ...]
    needed: Float[Array, ""]


class AbstractDiffusionPlan(eqx.Module):
    """A diffuser with everything that one geometry needs."""

    @abc.abstractmethod
    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: AbstractCombination,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        r"""Evaluate every layer at the splats, from all splats near each in object space, whichever
        way they face:

            mean_k(x) = sum_j A_j G(v_k, |x - q_j|) E_j / sum_j A_j G(v_k, |x - q_j|)

        **Arguments:**

        - `sources`: in the order of the plan. Differentiable.
        - `variances`: mm^2. Differentiable.
        - `combination`: of the parts of the splats that several devices hold.
        - `at`: the splats at which the layers are evaluated, in ascending order; there are none
          from the number of splats on. All for `None`.
        """

    def shares(self) -> tuple[Array, ...]:
        """Return the arrays of which every device has a share, along their first axis."""
        return ()


class AbstractDiffuser(eqx.Module):
    """A way to evaluate the diffusion integral; a setting."""

    @abc.abstractmethod
    def make_plan(
        self,
        parts: list[Splats],
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
    ) -> AbstractDiffusionPlan:
        """Find what evaluating these variances on this geometry needs. Not for traced arrays.

        **Arguments:**

        - `parts`: the splats, each part in the compact order in which they will be diffused
          (`compact_order`) and filled up to whole blocks by splats without area; several parts
          where several devices hold them.
        - `interval`: from `AbstractDiffusionKernel.interval`.
        """


def diffuse_with_derivative(
    plan: AbstractDiffusionPlan,
    sources: Sources,
    variances: Float[Array, " gaussians"],
    kernel: AbstractDiffusionKernel,
    combination: AbstractCombination,
    at: Int[Array, " points"] | None = None,
) -> tuple[Diffused, Diffused]:
    """Diffuse, and differentiate each layer in the logarithm of its own variance.

    Each layer depends on its own variance alone, so one direction holds all derivatives.
    """

    def diffuse(variances):
        return plan.diffuse(sources, variances, kernel, combination, at)

    return jax.jvp(diffuse, (variances,), (variances,))


def divide_by_mass(
    sums: Float[Array, "*rows values points"],
) -> Float[Array, "*rows values points"]:
    """Divide the light of each channel by the mass, which comes last; 0 where nothing is in
    reach.
    """
    light, mass = sums[..., :-1, :], sums[..., -1:, :]
    means = light / jnp.where(mass > 0, mass, 1.0)
    return jnp.where(mass > 0, jnp.concatenate([means, mass], axis=-2), 0.0)


def layer_values(
    sums: Float[Array, "values points"],
    first_moments: Float[Array, "values 3 points"],
    points: Float[Array, "3 points"],
) -> Float[Array, "_ points"]:
    r"""Divide the sums of one layer: rows of means, mass, and the slopes of both, in units that
    `split_layer` scales to 1/mm; all 0 where nothing is in reach.

    **Arguments:**

    - `sums`: `sum_j m_j w_j E_j` of each channel, and last `sum_j m_j w_j`.
    - `first_moments`: the same sums times the sources' places `q_j`.
    """
    mass = sums[-1]
    inverse = 1 / jnp.where(mass > 0, mass, 1.0)
    means = sums[:-1] * inverse[None]
    # grad N = sum w E (q - x) / v, and grad (N / D) = (grad N - (N / D) grad D) / D.
    gradients = first_moments - sums[:, None] * points[None]
    slopes = (gradients[:-1] - means[:, None] * gradients[-1:]) * inverse[None, None]
    slopes = jnp.concatenate([slopes, gradients[-1:]]).reshape(-1, mass.shape[0])
    return jnp.where(mass[None] > 0, jnp.concatenate([means, mass[None], slopes]), 0.0)


def split_layer(rows: Float[Array, "rows points"], scale: Float[Array, ""]) -> LayerValues:
    """Split the rows that `layer_values` stacks; `scale` makes slopes of them (1/mm)."""
    values = rows.shape[0] // 4
    return LayerValues(rows[:values], rows[values:].reshape(values, 3, -1) * scale)
