"""All pixels of all pictures that count, in one row, with the layers that were gathered for
them.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax.diffusion import LayersAtPoints
from splatjax.gaussians import SumOfGaussians
from splatjax.render import (
    DiffusionBasis,
    Plan,
    RenderSettings,
    diffusion_basis,
)
from splatjax.scattering import Medium
from splatjax.scene import AbstractLight, Camera, Material, Scene, Splats

from ._background import FILLED
from ._observation import nothing_counts
from ._plans import plans_of

_LARGER = 3.0
"""Of a wide range: the ratio of neighboring variances. It leaves dipoles an error of 0.2%."""
_NARROWEST, _WIDEST = (
    0.05,
    200.0,
)  # squared mean free paths: where the Gaussians of a dipole's fit lie, and beyond
_GRID = math.log(1.15)
"""Between the log variances that plans are made for; a plan holds for more than that."""
_REACH = 10.0
"""In variance: of coefficients that are off by a factor of three at the start."""


class FlatPictures(eqx.Module):
    """The pixels that count, and all that makes them but weights and intensities.

    Points come in this order: that of the surface in front for every pixel, then those behind
    silhouettes.
    """

    light: LayersAtPoints
    leaving: Float[Array, "channels points"]
    specular: Float[Array, "channels pixels"]
    behind: Int[Array, " behind"]
    """The pixel of each point behind."""
    picture: Int[Array, " pixels"]
    """The picture of each pixel."""

    def radiance(
        self, gaussians: SumOfGaussians, intensities: Float[Array, "pictures channels"]
    ) -> Float[Array, "channels pixels"]:
        """Give what the pixels are. Differentiable, in every mode."""
        count = self.specular.shape[1]
        points = self.leaving * self.light.exitance(gaussians)
        diffuse = points[:, :count].at[:, self.behind].add(points[:, count:])
        return intensities.T[:, self.picture] * (diffuse + self.specular)


def which_count(picture: DiffusionBasis, mask: np.ndarray) -> np.ndarray:
    """Give the numbers of the pixels that the body fills, among those of a mask."""
    return np.flatnonzero((np.asarray(picture.coverage) > FILLED).reshape(-1) & mask.reshape(-1))


def flatten(
    pictures: Sequence[DiffusionBasis], masks: Sequence[np.ndarray], dtype
) -> tuple[FlatPictures, list[np.ndarray]]:
    """Put the pixels of pictures in one row; also give their numbers in each picture.

    **Raises:** `ValueError` when no pixel of a picture counts.
    """
    fronts, backs, numbers, behind, specular = [], [], [], [], []
    before = 0
    for i, (picture, mask) in enumerate(zip(pictures, masks, strict=True)):
        chosen = which_count(picture, mask)
        if chosen.size == 0:
            raise nothing_counts(i)
        place = np.full(mask.size, -1)
        place[chosen] = np.arange(chosen.size)
        there = np.any(np.asarray(picture.leaving) > 0, axis=0)
        at, in_front = (
            np.where(there, place[np.asarray(picture.pixels)], -1),
            np.asarray(picture.in_front) > 0,
        )
        front, back = np.flatnonzero((at >= 0) & in_front), np.flatnonzero((at >= 0) & ~in_front)
        front = front[np.argsort(at[front])]
        fronts.append(_points(picture, front))
        backs.append(_points(picture, back))
        behind.append(at[back] + before)
        specular.append(np.asarray(picture.specular).reshape(mask.size, -1)[chosen].T)
        numbers.append(chosen)
        before += chosen.size
    rows, leaving = jax.tree.map(
        lambda *parts: jnp.asarray(np.concatenate(parts, axis=-1), dtype), *fronts, *backs
    )
    light = jax.tree.map(lambda leaf: leaf.astype(dtype), pictures[0].light)
    flat = FlatPictures(
        light=eqx.tree_at(_point_by_point, light, rows),
        leaving=leaving,
        specular=jnp.asarray(np.concatenate(specular, axis=1), dtype),
        behind=jnp.asarray(np.concatenate(behind).astype(np.int32)),
        picture=jnp.asarray(
            np.repeat(np.arange(len(numbers), dtype=np.int32), [each.size for each in numbers])
        ),
    )
    return flat, numbers


def _point_by_point(light: LayersAtPoints):
    """What of the light each point has its own of."""
    slopes = () if light.derivative is None else light.derivative
    return light.means, light.mass, light.irradiance, light.area, light.albedo, *slopes


def _points(picture: DiffusionBasis, places: np.ndarray):
    leaving = np.broadcast_to(np.asarray(picture.leaving), picture.light.irradiance.shape)
    return tuple(np.asarray(each)[..., places] for each in _point_by_point(picture.light)), leaving[
        ..., places
    ]


class Gatherer(eqx.Module):
    """Renders all that weights do not change; pictures that may share a plan do, so that nothing is
    compiled twice.
    """

    splats: Splats
    settings: RenderSettings
    cameras: list[Camera]
    lights: list[tuple[AbstractLight, ...]]

    def held(self, material: Material) -> list[DiffusionBasis]:
        """Gather for the variances of a material, and no others."""
        return self._gather(False, material, self._plans(material))

    def moving(
        self, material: Material, plans: list[Plan] | None = None
    ) -> tuple[list[DiffusionBasis], list[Plan]]:
        """Gather for variances near those of a material; the plans are those that are given, if
        they hold.
        """
        if plans is not None:
            found = self._gather(True, material, plans)
            if all(float(each.overflow) == 0 for each in found):
                return found, plans
        plans = self._plans(material)
        return self._gather(True, material, plans), plans

    def _gather(
        self, derivative: bool, material: Material, plans: list[Plan]
    ) -> list[DiffusionBasis]:
        together = zip(self._scenes(material), self.cameras, plans, strict=True)
        return [
            jax.block_until_ready(diffusion_basis(scene, camera, self.settings, its, derivative))
            for scene, camera, its in together
        ]

    def _scenes(self, material: Material) -> list[Scene]:
        return [Scene(self.splats, lights, material) for lights in self.lights]

    def _plans(self, material: Material) -> list[Plan]:
        return plans_of(self._scenes(_rounded(material)), self.cameras, self.settings)


def _rounded(material: Material) -> Material:
    """Give variances on a coarse grid: materials that are nearly alike have plans of the same
    shapes, and one program.
    """
    gaussians = material.gaussians
    variances = jnp.exp(jnp.round(jnp.log(gaussians.variances) / _GRID) * _GRID)
    return material.surface_of(SumOfGaussians(variances, gaussians.weights))


def wide_variances(media: Sequence[Medium], splats: Splats) -> Float[Array, " gaussians"]:
    r"""Give variances (mm^2) that serve all media near some: each three times the one before.

    They hold what coefficients up to three times as large, or as small, make of a dipole. None is
    much wider than the body.
    """
    paths = np.concatenate([1 / np.asarray(medium.sigma_t_prime, np.float64) for medium in media])
    root = np.concatenate([np.asarray(medium.squared_sigma_tr, np.float64) for medium in media])
    diffuse = 1 / np.sqrt(np.maximum(root, 1e-12))
    low, high = (
        _NARROWEST * np.min(paths**2) / _REACH,
        np.max(np.maximum(_WIDEST * paths**2, 3 * diffuse**2)) * _REACH,
    )
    size = float(np.sum(np.var(np.asarray(splats.centers, np.float64), axis=0)))
    high = max(min(high, size), _LARGER * low)
    count = max(2, math.ceil(math.log(high / low) / math.log(_LARGER)) + 1)
    return jnp.asarray(low * _LARGER ** np.arange(count), media[0].sigma_a.dtype)
