"""What lies within a body is a hollow: which side of it is outside."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

_BLOCK = 32  # points that are seen from afar as one
_PROBES = 256
_CLEAR = 0.05


def turn_cavities(
    points: Float[np.ndarray, "n 3"],
    oriented: Float[np.ndarray, "n 3"],
    patches: Sequence[Int[np.ndarray, " _"]],
    signs: Float[np.ndarray, " n"],
) -> None:
    r"""Turn patches around, in place, that would make a body within a body.

    The winding number of a surface is 0 outside, 1 inside and on the surface itself their mean,
    1/2. A patch is turned when that brings the number on it, of everything else and of itself,
    nearer to 1/2: a shell within a body makes it 3/2 where it faces outward, and 1/2 where it faces
    its middle. The greatest patch comes first.

    **Arguments:**

    - `points`: mm, near each other in their order as far as may be.
    - `oriented`: normals as long as the point's area, mm^2; those of turned patches are turned.
    - `patches`: points of each.
    - `signs`: those of turned patches are turned.

    **Source:** Barill et al. 2018, "Fast Winding Numbers for Soups and Clouds", equation 4; Xu et
    al. 2023, "Globally Consistent Normal Orientation for Point Clouds by Regularizing the
    Winding-Number Field".
    """
    for patch in sorted(patches, key=len, reverse=True):
        probes = points[
            patch[np.linspace(0, len(patch) - 1, min(len(patch), _PROBES)).astype(np.int64)]
        ]
        everything = np.median(_winding(probes, points, oriented))
        own = np.median(_winding(probes, points[patch], oriented[patch]))
        if (everything - own - 0.5) * own > _CLEAR:
            signs[patch] *= -1
            oriented[patch] *= -1


def _winding(
    probes: Float[np.ndarray, "probes 3"],
    points: Float[np.ndarray, "n 3"],
    oriented: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " probes"]:
    """Give winding numbers on a surface, of points in blocks; those of a block that a probe belongs
    to nearly cancel.
    """
    starts = np.arange(0, len(points), _BLOCK)
    sizes = np.diff(np.append(starts, len(points)))
    middles, normals = (
        np.add.reduceat(points, starts) / sizes[:, None],
        np.add.reduceat(oriented, starts),
    )
    found = np.empty(len(probes))
    for i, probe in enumerate(probes):  # one by one, in memory that does not grow with both
        way = middles - probe[None]
        cubed = np.einsum("bi,bi->b", way, way) ** 1.5
        found[i] = (np.einsum("bi,bi->b", way, normals) / np.where(cubed > 0, cubed, np.inf)).sum()
    return found / (4 * np.pi)
