"""All pixels of all pictures that count, in one row, with the layers at their points."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax.diffusion import LayersAtPoints
from splatjax.gaussians import SumOfGaussians
from splatjax.render import DiffusionBasis

from ._losses import FILLED
from ._observation import Evidence, nothing_counts


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
        """Compute the radiance of the pixels. Differentiable, in every mode."""
        count = self.specular.shape[1]
        points = self.leaving * self.light.exitance(gaussians)
        diffuse = points[:, :count].at[:, self.behind].add(points[:, count:])
        return intensities.T[:, self.picture] * (diffuse + self.specular)


def which_count(
    pictures: Sequence[DiffusionBasis], evidence: Sequence[Evidence]
) -> list[np.ndarray]:
    """Find the pixels of each picture that are known and filled by the body.

    **Raises:** `ValueError` when no pixel of a picture counts.
    """
    counted = [
        (np.asarray(picture.coverage) > FILLED) & np.asarray(one.known)
        for picture, one in zip(pictures, evidence, strict=True)
    ]
    for i, mask in enumerate(counted):
        if not mask.any():
            raise nothing_counts(i)
    return counted


def in_a_row(pictures: Sequence[Array], counted: Sequence[np.ndarray]) -> np.ndarray:
    """Put the pixels that count in one row, `[channels, pixels]`."""
    together = zip(pictures, counted, strict=True)
    return np.concatenate([np.asarray(picture)[mask] for picture, mask in together]).T


def in_pictures(
    row: Float[Array, "channels pixels"], counted: Sequence[np.ndarray]
) -> tuple[np.ndarray, ...]:
    """Return the pixels to their pictures; NaN where they do not count."""
    pictures = tuple(np.full((*mask.shape, len(row)), np.nan) for mask in counted)
    parts = np.split(np.asarray(row).T, np.cumsum([np.sum(mask) for mask in counted])[:-1])
    for picture, mask, values in zip(pictures, counted, parts, strict=True):
        picture[mask] = values
    return pictures


def flatten(
    pictures: Sequence[DiffusionBasis], counted: Sequence[np.ndarray], dtype
) -> FlatPictures:
    """Put the pixels of pictures that count in one row."""
    pixels, total = [], 0
    for picture, mask in zip(pictures, counted, strict=True):
        place = np.where(mask.reshape(-1), total + np.cumsum(mask) - 1, -1)
        is_lit = np.any(np.asarray(picture.leaving) > 0, axis=0)
        pixels.append(np.where(is_lit, place[np.asarray(picture.pixels)], -1))
        total += int(np.sum(mask))
    pixel = np.concatenate(pixels)
    is_behind = np.concatenate([np.asarray(picture.in_front) == 0 for picture in pictures])
    order = np.lexsort((pixel, is_behind))
    order = order[pixel[order] >= 0]
    rows, leaving = jax.tree.map(
        lambda *parts: jnp.asarray(np.concatenate(parts, axis=-1)[..., order], dtype),
        *[_by_point(picture) for picture in pictures],
    )
    light = jax.tree.map(lambda leaf: leaf.astype(dtype), pictures[0].light)
    number = np.repeat(np.arange(len(counted)), [np.sum(mask) for mask in counted])
    return FlatPictures(
        light=eqx.tree_at(lambda each: each.rows, light, rows),
        leaving=leaving,
        specular=jnp.asarray(in_a_row([one.specular for one in pictures], counted), dtype),
        behind=jnp.asarray(pixel[order[total:]], jnp.int32),
        picture=jnp.asarray(number, jnp.int32),
    )


def _by_point(picture: DiffusionBasis):
    leaving = jnp.broadcast_to(picture.leaving, picture.light.irradiance.shape)
    return jax.tree.map(np.asarray, (picture.light.rows, leaving))
