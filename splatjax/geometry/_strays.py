"""Points that belong to no surface."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Bool, Float, Int

_NEIGHBORS = 8
_ALONE = 5.0  # times farther from its neighbors than they are from theirs


def strays(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
    r"""Tell which points lie alone: much farther from their neighbors than these are from their
    own, and no one's neighbors.

    So that neither a place where all points are sparse holds one, nor the border between dense and
    sparse.

    **Returns:** whether each is one, its nearest neighbors, and its mean distance to them, mm.

    **Source:** after Breunig et al. 2000, "LOF: Identifying Density-Based Local Outliers", medians
    in the place of means.
    """
    distances, near = scipy.spatial.KDTree(points).query(
        points, k=min(_NEIGHBORS, len(points) - 1) + 1, workers=-1
    )
    mean, near = distances[:, 1:].mean(axis=1), near[:, 1:]
    wanted = np.bincount(near.ravel(), minlength=len(points)) > 0
    return (mean > _ALONE * np.median(mean[near], axis=1)) & ~wanted, near, mean
