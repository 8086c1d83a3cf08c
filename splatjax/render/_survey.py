"""What must be known of all splats before a picture of them can be begun, from a look at one part
after the other.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import Parts, Splats

_OTHERS = (
    "the parts were not the same each time that they were asked for; give the same "
    "splats in the same order"
)


class SameParts:
    """Parts that must be the same each time that they are asked for: what is known of one is used
    when it comes again.
    """

    def __init__(self, parts: Parts):
        self.parts, self.marks = parts, None

    def __call__(self) -> Iterator[Splats]:
        """Give all splats from the beginning.

        **Raises:** `ValueError` when a part is another one than the first time, or there are fewer
        or more.
        """
        marks = []
        for part in self.parts():
            marks.append(np.asarray(_mark(part)))
            self._check(marks)
            yield part
        self.marks = marks if self.marks is None else self.marks
        if len(marks) != len(self.marks):
            raise ValueError(_OTHERS)

    def _check(self, marks: list[np.ndarray]) -> None:
        if self.marks is not None and not np.array_equal(
            marks[-1:], self.marks[len(marks) - 1 : len(marks)], equal_nan=True
        ):
            raise ValueError(_OTHERS)


@jax.jit
def _mark(splats: Splats) -> Float[Array, " leaves"]:
    return jnp.stack([jnp.sum(leaf) for leaf in jax.tree.leaves(splats)])


@dataclass(frozen=True)
class Survey:
    """Numbers of all splats. Lengths in mm."""

    count: int
    rows: int
    """Splats of a part, but the last."""
    low: np.ndarray
    high: np.ndarray
    reach: float
    """From the middle of the box to the farthest rim."""
    spacing: float
    """Root of the mean area."""
    fine: float
    """Area that one splat in a hundred is finer than."""
    unevenness: float
    """As `diffusion.irregularity`, but that neighbors are those in the same part."""

    @classmethod
    def of(cls, parts: Parts) -> "Survey":
        """Look at all parts twice, and keep the areas of the finest.

        **Raises:** `ValueError` when there are no splats, or a part is larger than the first, or
        smaller and not the last.
        """
        sizes, low, high, area, radius = [], [], [], 0.0, 0.0
        for part in parts():
            if part.count == 0:
                continue
            centers, own = np.asarray(part.centers), np.asarray(part.areas)
            sizes.append(part.count)
            low.append([axis.min() for axis in centers.T])  # quicker than over an axis of three
            high.append([axis.max() for axis in centers.T])
            area, radius = (
                area + float(own.sum(dtype=np.float64)),
                max(radius, float(part.radii.max())),
            )
        if not sizes:
            raise ValueError("there are no splats to stream")
        if any(size != sizes[0] for size in sizes[:-1]) or sizes[-1] > sizes[0]:
            raise ValueError(
                "parts must be of one size, but the last, which may be smaller; these are of "
                f"{sizes}"
            )
        lowest, highest = np.min(low, axis=0), np.max(high, axis=0)
        middle, squared, begin, near, count = (lowest + highest) / 2, 0.0, 0, [], sum(sizes)
        places = np.linspace(0, count - 1, min(_diffusion.PLACES, count)).astype(int)
        rank, finest = _diffusion.FINEST * (count - 1), np.zeros(0)
        for part in parts():
            squared = max(
                squared, float(np.max(_squares(np.asarray(part.centers), middle), initial=0))
            )
            near += _nearest(
                part, places[(places >= begin) & (places < begin + part.count)] - begin
            )
            finest = _smallest(np.concatenate([finest, np.asarray(part.areas)]), int(rank) + 2)
            begin += part.count
        distances = np.asarray(near)
        return cls(
            count=count,
            rows=sizes[0],
            low=lowest,
            high=highest,
            reach=math.sqrt(squared) + radius,
            spacing=math.sqrt(area / count),
            fine=float(np.interp(rank, np.arange(len(finest)), np.sort(finest))),
            unevenness=float(np.std(distances) / max(np.mean(distances), 1e-300)),
        )

    @property
    def middle(self) -> np.ndarray:
        """Of the box around all centers."""
        return (self.low + self.high) / 2

    def bounds(self, dtype) -> _splatting.Bounds:
        """Give the sphere around all discs."""
        return _splatting.Bounds(jnp.asarray(self.middle, dtype), jnp.asarray(self.reach, dtype))

    def interval(self, settings: _diffusion.DiffusionSettings, dtype) -> Float[Array, "2"]:
        """Give the interval of the layers' handover."""
        return _diffusion.handover_interval(jnp.asarray(self.unevenness, dtype), settings)


def _squares(centers: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Give squared distances, axis by axis, which is quicker."""
    return sum((axis - at) ** 2 for axis, at in zip(centers.T, place, strict=True))


def _smallest(values: np.ndarray, count: int) -> np.ndarray:
    return values if len(values) <= count else np.partition(values, count - 1)[:count]


def _nearest(part: Splats, places: np.ndarray) -> list[float]:
    """Give the distance of splats to the nearest other one of their part, over the root of their
    area; of the only one 0.
    """
    centers, areas, found = np.asarray(part.centers), np.asarray(part.areas), []
    for place in places:
        squared = np.delete(_squares(centers, centers[place]), place)
        found.append(
            math.sqrt(np.min(squared, initial=np.inf) / areas[place]) if len(squared) else 0.0
        )
    return found
