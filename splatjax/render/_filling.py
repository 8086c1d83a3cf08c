"""Padding of scenes, so that many share a program, and sorting in the order of a plan."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Int, Shaped

from splatjax.gaussians import SumOfGaussians
from splatjax.scene import AbstractLightSample, Splats


def fill_up(splats: Splats, count: int) -> Splats:
    """Add invisible splats without light, up to `count`."""
    if splats.count == count:
        return splats
    return splats.take(jnp.arange(count, dtype=jnp.int32))


def fill_gaussians(gaussians: SumOfGaussians) -> SumOfGaussians:
    """Add Gaussians without weight, too narrow to be resolved, beyond three up to a multiple of
    three. Not for traced arrays; nothing is compiled.
    """
    count = len(gaussians.variances)
    lacking = -count % 3 if count > 3 else 0
    if not lacking:
        return gaussians
    variances, weights = np.asarray(gaussians.variances), np.asarray(gaussians.weights)
    narrow = np.full(lacking, 1e-6 * variances.min(), variances.dtype)
    rows = np.concatenate([variances, narrow]), np.pad(weights, ((0, lacking), (0, 0)))
    return SumOfGaussians(*(jax.device_put(each) for each in rows))


def fill_lights(
    group: list[tuple[int, AbstractLightSample]], number: int
) -> list[tuple[int, AbstractLightSample]]:
    """Repeat the last light of a group with zero strength, up to four or a power of two."""
    last = group[-1][1]
    none = jax.device_put(np.zeros_like(getattr(last, last.strength_field)))
    dark = eqx.tree_at(lambda light: getattr(light, light.strength_field), last, none)
    return [(number, dark)] * ((1 << max(len(group) - 1, 2).bit_length()) - len(group))


def rows_at(
    rows: Shaped[Array, "rows ..."], places: Int[np.ndarray, " places"]
) -> Shaped[Array, "places ..."]:
    """Take rows, the last one for indices beyond them. Outside `jit` nothing is compiled."""
    if np.array_equal(places, np.arange(len(rows))):
        return rows
    if isinstance(rows, Tracer):
        return jnp.take(rows, places, axis=0, mode="clip")
    return jax.device_put(np.take(np.asarray(rows), places, axis=0, mode="clip"))


def arrange(
    splats: Splats,
    order: Int[Array, " places"] | Int[np.ndarray, " places"],
    exists: Bool[Array, " places"] | Bool[np.ndarray, " places"],
) -> Splats:
    """Sort a device's splats in the order of a plan; repeated ones are invisible and dark."""
    placed = jax.tree.map(lambda leaf: leaf[order], splats)

    def masked(leaf):
        where = np.where if isinstance(leaf, np.ndarray) else jnp.where
        return where(exists.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, 0)

    return eqx.tree_at(
        lambda splats: (splats.normals, splats.radii, splats.areas), placed, replace_fn=masked
    )
