"""The diffusion integral of the irradiance for every layer (pass 4, section 4.2)."""

import abc
import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from splatjax._combination import DeviceMesh
from splatjax._smooth import albedo_root
from splatjax.gaussians import SumOfGaussians
from splatjax.scene import Material, Scene, Splats

from ._kernel import AbstractDiffusionKernel

_WIDE = 1e12  # variance of a layer that all splats resolve, mm^2


class Sources(eqx.Module):
    """The splats, or clusters of them, as sources of diffused light.

    **Attributes:**

    - `normals`: `None` for sources that lie below their splats already.
    - `irradiance`: the irradiance that spreads: one for all layers, or one for each.
    - `weights`: factors of the splats on the weights of the material; `None` for 1.
    """

    centers: Float[Array, "3 sources"]
    normals: Float[Array, "3 sources"] | None
    areas: Float[Array, " sources"]
    irradiance: Float[Array, "channels *layers sources"]
    weights: Float[Array, "gaussians channels sources"] | None = None

    @classmethod
    def of(cls, splats: Splats, irradiance: Float[Array, "channels splats"]) -> "Sources":
        weights = None if splats.weights is None else splats.weights.transpose(1, 2, 0)
        return cls(splats.centers.T, splats.normals.T, splats.areas, irradiance, weights)

    def of_layers(self, gaussians: Int[Array, " layers"]) -> "Sources":
        """Multiply the irradiance of every layer by the root of the factor on its weight."""
        if self.weights is None:
            return self
        roots = albedo_root(self.weights).at[gaussians].get(mode="fill", fill_value=0)
        light = self.irradiance[:, None] * roots.swapaxes(0, 1)
        return Sources(self.centers, self.normals, self.areas, light)


class Beams(eqx.Module):
    """Light that enters a body, one beam for each splat: the sum of all lights, with the mean of
    their directions.

    **Attributes:** (differentiable)

    - `irradiance`: the irradiance that enters, after the loss at the surface.
    - `directions`: the mean directions of the light inside (mean displacement of the first
      scattering, per mean free path): unit for one light, shorter for several.
    """

    irradiance: Float[Array, "channels splats"]
    directions: Float[Array, "channels 3 splats"]


class LayerValues(eqx.Module):
    """Layers at some points.

    **Attributes:**

    - `values`: for each channel the weighted mean of the nearby irradiance, which preserves
      constants, lies between the least and the greatest irradiance, and is linear in it; last, the
      kernel's mass on the surface, 1 on a flat sheet. Or only the radiant exitance per channel.
    - `slopes`: the slopes of the values in space, 1/mm.
    """

    values: Float[Array, "*layers values points"]
    slopes: Float[Array, "*layers values 3 points"]


class Diffused(eqx.Module):
    """The layers on the splats.

    **Attributes:**

    - `layers`: the layers, in the order of `AbstractDiffusionPlan.gaussians`.
    - `needed`: needed capacity divided by planned capacity; above 1 the values are incomplete.
    """

    layers: LayerValues
    needed: Float[Array, ""]


class AbstractDiffusionPlan(eqx.Module):
    """A diffuser with its plan for one geometry.

    **Attributes:**

    - `gaussians`: the Gaussian of each evaluated layer; for a padding layer, the number of
      Gaussians. Omitted Gaussians are too narrow for nearly all splats.
    - `forward_mode`: for a diffuser without derivatives in both modes, whether the layers are
      differentiable in forward mode instead of reverse mode. Static.
    - `separate`: whether there is a layer for each Gaussian, or one with the radiant exitance.
    """

    gaussians: Int[Array, " layers"]
    forward_mode: bool = eqx.field(static=True, default=False, kw_only=True)
    separate = True

    def variances_of_layers(self, variances: Float[Array, " gaussians"]) -> Float[Array, " layers"]:
        """Look up the variances of the layers among those of the Gaussians, mm^2; 1 for a padding
        layer.
        """
        return variances.at[self.gaussians].get(mode="fill", fill_value=1)

    def material(self, material: Material) -> Material:
        """Return the material of the layers, reduced to the parameters on which they depend."""
        return dataclasses.replace(material, medium=None)

    def shown(self, scene: Scene) -> Scene:
        """Return the scene with the weights of the layers that passes 2 and 3 blend: unchanged, or,
        where `light` has applied the weights already, with one layer of weight 1 that all splats
        resolve.
        """
        if self.separate:
            return scene
        gaussians = scene.material.gaussians
        variances = jnp.full_like(gaussians.variances[:1], _WIDE)
        one_layer = SumOfGaussians(variances, jnp.ones_like(gaussians.weights[:1]))
        material = dataclasses.replace(scene.material, gaussians=one_layer)
        return Scene(dataclasses.replace(scene.splats, weights=None), scene.lights, material)

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: DeviceMesh,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        r"""Evaluate the layers at the splats, from all nearby splats in object space, of any
        orientation:

            mean_k(x) = sum_j A_j G(v_k, |x - q_j|) E_j / sum_j A_j G(v_k, |x - q_j|)

        **Arguments:**

        - `sources`: the splats as sources, in the order of the plan. Differentiable.
        - `variances`: mm^2. Differentiable.
        - `combination`: combines the parts of the splats of several devices.
        - `at`: the splats at which the layers are evaluated, in ascending order, padded by the
          number of splats. All for `None`.

        **Raises:** `ValueError` for a plan without separate layers.
        """
        raise ValueError(
            f"{type(self).__name__} has no separate layers, and evaluates only the light of a "
            "scene; make the plan with ClusterDiffuser()"
        )

    def light(
        self,
        splats: Splats,
        material: Material,
        source: Float[Array, "channels splats"],
        beams: Callable[[], Beams],
        kernel: AbstractDiffusionKernel,
        combination: DeviceMesh,
        at: Int[Array, " points"] | None = None,
        bounced: Float[Array, "channels splats"] | None = None,
    ) -> tuple[Diffused, PyTree]:
        """Evaluate the layers of lit splats: diffuse their irradiance, or solve for the light of
        the beams that enter them.

        **Arguments:** as for `diffuse`.

        - `source`: the irradiance that spreads.
        - `beams`: computes the beams, if a plan needs them.
        - `bounced`: the part of the source that comes from other parts of the body, uniformly, and
          not from the beams.

        **Returns:** the layers, and the solution on all splats that `towards` needs.
        """
        sources = Sources.of(splats, source)
        return self.diffuse(sources, material.gaussians.variances, kernel, combination, at), None

    def towards(
        self,
        eye: Float[Array, "3"],
        splats: Splats,
        material: Material,
        layers: LayerValues,
        solved: PyTree,
        at: Int[Array, " points"],
    ) -> LayerValues:
        """Return the layers as seen by an eye; unchanged if light leaves equally in all directions.

        **Arguments:** all splats, and the layers at `at` and the solution returned by `light`.
        """
        return layers

    def diffuse_with_derivative(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: DeviceMesh,
        at: Int[Array, " points"] | None = None,
    ) -> tuple[Diffused, Diffused]:
        """Diffuse, and differentiate each layer with respect to the logarithm of its variance."""

        plan = dataclasses.replace(self, forward_mode=True)

        def diffuse(variances):
            return plan.diffuse(sources, variances, kernel, combination, at)

        # Each layer depends on its own variance alone, so one direction holds all derivatives.
        return jax.jvp(diffuse, (variances,), (variances,))

    def shares(self) -> tuple[Array, ...]:
        """Return the arrays of which every device has a share, along their first axis."""
        return ()


class AbstractDiffuser(eqx.Module):
    """A way to evaluate the diffusion integral; a setting."""

    @abc.abstractmethod
    def make_plan(
        self,
        splats: Splats,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
        devices: int = 1,
    ) -> AbstractDiffusionPlan:
        """Plan the evaluation of Gaussians of these variances on this geometry. Not for traced
        arrays.

        **Arguments:**

        - `splats`: the splats of one device after the other, each in the compact order in which
          they will be diffused (`compact_order`) and filled up to whole blocks by splats without
          area.
        - `interval`: standard deviations per spacing between which layers become resolved
          (`AbstractDiffusionKernel.interval`).
        - `devices`: the number of devices, each of which has as many of the splats.
        """


def _light_and_mass(rows: Float[Array, "..."], axis: int) -> Sequence[Float[Array, "..."]]:
    """Separate the channels from the mass. The derivative of slices would be a sum."""
    return jax.lax.split(rows, (rows.shape[axis] - 1, 1), axis=axis)


def layer_values(
    sums: Float[Array, "*layers values 4 points"],
    points: Float[Array, "*layers 3 points"],
    per_mm: Float[Array, "*layers #points"],
    per_flat: Float[Array, "*layers #points"],
) -> LayerValues:
    r"""Compute layers and their slopes from sums over sources; 0 where nothing is in reach.

    **Arguments:**

    - `sums`: of light in each channel, and last of mass: `sum_j m_j w_j (1, q_j)`, the places
      `q_j` of the sources counted from one origin with `points`.
    - `per_mm`: the factor from the unit of the places to the unit of the slopes.
    - `per_flat`: the factor from the mass to the mass relative to a flat sheet.
    """
    total, first_moments = jax.lax.split(sums, (1, 3), axis=-2)
    # grad N = sum w E (q - x) / v, and grad (N / D) = (grad N - (N / D) grad D) / D.
    of_light, of_mass = _light_and_mass(first_moments - total * points[..., None, :, :], -3)
    light, mass = _light_and_mass(total[..., 0, :], -2)
    inverse = 1 / jnp.where(mass > 0, mass, 1.0)
    means = light * inverse
    of_means = (of_light - means[..., None, :] * of_mass) * inverse[..., None, :]
    # A flat sheet has mass 1.
    row, slope = per_flat[..., None, :], per_mm[..., None, None, :]
    return LayerValues(
        jnp.concatenate([means, row * mass], axis=-2),
        slope * jnp.concatenate([of_means, row[..., None, :] * of_mass], axis=-3),
    )
