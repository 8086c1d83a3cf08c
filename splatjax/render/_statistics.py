"""Statistics of all splats of a stream, computed before a picture is rendered."""

import math
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import Parts, Splats


class ReplayableStream:
    """Parts that must be the same at each iteration, because an iteration uses results of the one
    before. After each part, the number of finished splats is reported.
    """

    def __init__(self, parts: Parts, report: Callable[[str, int], None] | None):
        self.parts, self.report, self.marks = parts, report, None

    def __call__(self, task: str) -> Iterator[Splats]:
        """Iterate over all splats from the beginning.

        **Raises:** `ValueError` if a part, or the number of parts, differs from the first
        iteration.
        """
        marks, done = [], 0
        for part in self.parts():
            marks.append(np.asarray(_mark(part)).tobytes())
            yield part
            done += part.count
            if self.report is not None:
                self.report(task, done)
        if self.marks not in (None, marks):
            raise ValueError("parts must return the same splats in the same order at each call")
        self.marks = marks


@jax.jit
def _mark(splats: Splats) -> Float[Array, " leaves"]:
    return jnp.stack([jnp.sum(leaf) for leaf in jax.tree.leaves(splats)])


def measure_stream(
    parts: Parts,
) -> tuple[int, _splatting.Bounds, float, float, Float[Array, ""], Float[Array, ""]]:
    """Read all parts twice, and keep the areas of the finest splats.

    **Returns:**

    - the number of splats in every part but the last;
    - the middle of the box around all centers, and the distance of the farthest one, plus the
      largest radius, mm;
    - the root of the mean area, mm, and the first percentile of the area, mm^2, of splats with a
      nonzero area; infinite without such splats;
    - the mean of the unevenness of the parts, weighted by these splats; and the sum of their
      squared radii divided by the sum of their areas.

    **Raises:** `ValueError` when there are no splats, or a part is larger than the first, or
    smaller and not the last.
    """
    # Sizes, extent and areas.
    sizes, boxes, largest, sums = [], [], [], []
    for part in filter(lambda part: part.count, parts()):
        areas, radii = np.asarray(part.areas), np.asarray(part.radii)
        sizes.append(part.count)
        # Quicker than over an axis of three.
        boxes.append([(axis.min(), axis.max()) for axis in np.asarray(part.centers).T])
        largest.append(radii.max())
        squares = np.sum(radii**2, where=areas > 0, dtype=np.float64)
        sums.append((np.count_nonzero(areas), areas.sum(dtype=np.float64), squares))
    if not sizes:
        raise ValueError("parts has no splats; give at least one")
    if any(size != sizes[0] for size in sizes[:-1]) or sizes[-1] > sizes[0]:
        raise ValueError(
            f"parts must have one size, except for a smaller last one; these have {sizes} splats"
        )
    # Distance of the farthest splat, finest areas, and unevenness.
    count, area, square = np.sum(sums, axis=0).tolist()
    middle = (np.min(boxes, axis=0)[:, 0] + np.max(boxes, axis=0)[:, 1]) / 2
    farthest, finest, uneven = 0.0, np.zeros(0), 0.0
    rank = _diffusion.FINE_QUANTILE * max(count - 1, 0)
    for part in filter(lambda part: part.count, parts()):
        away, areas = (np.asarray(part.centers) - middle).T, np.asarray(part.areas)
        farthest = max(farthest, float(np.max(sum(axis * axis for axis in away))))
        finest = np.sort(np.concatenate([finest, areas[areas > 0]]))[: int(rank) + 2]
        uneven += np.count_nonzero(areas) * float(_diffusion.unevenness(part))
    dtype = part.centers.dtype
    reach = math.sqrt(farthest) + float(max(largest))
    return (
        sizes[0],
        _splatting.Bounds(jnp.asarray(middle, dtype), jnp.asarray(reach, dtype)),
        math.sqrt(area / count) if count else math.inf,
        float(np.interp(rank, np.arange(len(finest)), finest)) if count else math.inf,
        jnp.asarray(uneven / max(count, 1), dtype),
        jnp.asarray(square / area if area else 1.0, dtype),
    )
