"""Smooth maps over the surface: offsets along the normals, and parameters of the material such as
melanin and blood.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Array, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax._memory import check_memory
from splatjax._records import as_floats, check_values
from splatjax.fitting import WeightTable
from splatjax.geometry import tangent_frames
from splatjax.scene import Material, Splats

from ._observation import PicturedScene
from ._parts import BOUNDED, AbstractPart

_REACH = 2.5  # reach of the blur, standard deviations
_SLOPES = 17  # number of splats to measure a slope, including the splat itself
_ROUNDED = 16  # neighbor counts are multiples of this, so that similar bodies share a program
_SAME_SIDE = 0.3  # least cosine between normals of splats that belong together
_SAME = 1e-5  # relative difference between the Gaussians of a table and those of the material


class SurfaceMean(eqx.Module):
    """A Gaussian mean over the neighbors of each splat on the same side of the body.

    **Attributes:**

    - `near`: the neighbors; neighbors out of reach or on another side have weight 0.
    - `gain`: root mean square of the mean of independent noise with deviation 1.
    """

    near: Int[Array, "splats _near"]
    weights: Float[Array, "splats _near"]
    gain: Float[Array, ""]

    @classmethod
    def of(cls, splats: Splats, width: float) -> "SurfaceMean":
        """Find the neighbors of splats for a blur with a standard deviation in mm."""
        fields = (splats.centers, splats.normals, splats.areas)
        centers, normals, areas = (np.asarray(field, np.float64) for field in fields)
        tree = scipy.spatial.KDTree(centers)
        reach = _REACH * width
        most = int(np.max(tree.query_ball_point(centers, reach, return_length=True)))
        what = f"a mean over up to {most} neighbors of each splat, within {reach:g} mm,"
        check_memory(what, 64.0 * most * len(areas), "give a smaller smoothness, or fewer splats")
        order = np.arange(1, -(-most // _ROUNDED) * _ROUNDED + 1)
        distances, near = tree.query(centers, k=order, distance_upper_bound=reach, workers=-1)
        counts = near < len(areas)
        near = np.where(counts, near, np.arange(len(areas))[:, None])
        counts &= np.einsum("nki,ni->nk", normals[near], normals) > _SAME_SIDE
        blur = np.exp(-0.5 * (np.where(counts, distances, 0.0) / width) ** 2)
        weights = np.where(counts, blur * areas[near], 0.0)
        weights /= np.sum(weights, axis=1, keepdims=True)
        gain, dtype = np.sqrt(np.mean(np.sum(weights**2, axis=1))), splats.centers.dtype
        return cls(
            jnp.asarray(near, jnp.int32), jnp.asarray(weights, dtype), jnp.asarray(gain, dtype)
        )

    def __call__(self, rows: Float[Array, "splats columns"]) -> Float[Array, "splats columns"]:
        return jnp.sum(self.weights[..., None] * rows[self.near], axis=1)


class OffsetTables(eqx.Module):
    """The mean of offsets, the neighbors of each splat, and the weights for derivatives over
    them.
    """

    mean: SurfaceMean
    around: Int[Array, "splats _around"]  # neighbors from which slopes are computed
    # Weights of derivatives, exact for quadratic functions.
    slopes: Float[Array, "splats _around 2"]
    tangents: Float[Array, "splats 2 3"]  # directions of the derivatives


class NormalOffsets(AbstractPart):
    r"""A displacement map, the offset of each splat along its initial normal.

        part = NormalOffsets(step=0.02, smoothness=0.9, deviation=0.4)  # mm

    Independent offsets of neighboring splats would cause noise and holes, so the coordinates `x`
    are blurred over the surface:

        offset = step blur(x),   center = start + offset normal

    The blur is a mean over the surface with Gaussian weights, so no offset exceeds `step` times the
    largest coordinate nearby. Normals, areas and radii follow the displaced surface. A splat
    farther than 2.5 `smoothness` from all visible splats does not move.

    **Attributes:** (static)

    - `step`: offset for a coordinate of 1, mm.
    - `smoothness`: standard deviation of the blur, mm, usually a few spacings of the splats. Finer
      bumps are not recovered.
    - `deviation`: standard deviation of the normal prior of an offset, mm.
    """

    shared = True
    step: float = eqx.field(static=True)
    smoothness: float = eqx.field(static=True)
    deviation: float = eqx.field(static=True)

    def prepared(self, splats: Splats) -> OffsetTables:
        check_values(
            "the number of splats",
            splats.count,
            f"at least {_SLOPES} for NormalOffsets, which measures slopes among them",
            lambda x: x >= _SLOPES,
        )
        around, tangents, slopes = _slopes(
            np.asarray(splats.centers, np.float64), np.asarray(splats.normals, np.float64)
        )
        dtype = splats.centers.dtype
        return OffsetTables(
            SurfaceMean.of(splats, self.smoothness),
            jnp.asarray(around, jnp.int32),
            jnp.asarray(slopes, dtype),
            jnp.asarray(tangents, dtype),
        )

    def coordinates(self, pictured: PicturedScene) -> Float[Array, " splats"]:
        return jnp.zeros_like(pictured.splats.areas)

    @jit_unless_traced
    def moved(self, pictured: PicturedScene, x, prepared: OffsetTables) -> PicturedScene:
        splats = pictured.splats
        shifts = self.step * prepared.mean(x[:, None]) * splats.normals
        apart = shifts[prepared.around] - shifts[:, None]
        # Tilt the initial tangents by the slopes of the offsets along them.
        along = prepared.tangents + jnp.sum(prepared.slopes[..., None] * apart[:, :, None], axis=1)
        across = jnp.cross(along[:, 0], along[:, 1])
        stretch = jnp.sqrt(jnp.sum(across * across, axis=1))
        centers, normals = splats.centers + shifts, across / stretch[:, None]
        return eqx.tree_at(
            lambda s: (s.splats.centers, s.splats.normals, s.splats.areas, s.splats.radii),
            pictured,
            (centers, normals, splats.areas * stretch, splats.radii * jnp.sqrt(stretch)),
        )

    def prior_residuals(self, x: Float[Array, " splats"], prepared: OffsetTables):
        return self.step * prepared.mean.gain / self.deviation * x


def _slopes(centers: np.ndarray, normals: np.ndarray):
    """Find neighbors, tangents, and weights for derivatives along the tangents, by least squares
    with quadratic terms.
    """
    around = scipy.spatial.KDTree(centers).query(centers, k=_SLOPES, workers=-1)[1][:, 1:]
    tangents = np.stack(tangent_frames(normals), axis=1)
    u, v = np.einsum("nki,nai->ank", centers[around] - centers[:, None], tangents)
    size = np.sqrt(np.mean(u * u + v * v, axis=1, keepdims=True))
    u, v = u / size, v / size
    trust = np.exp(-0.5 * (u * u + v * v)) * (
        np.einsum("nki,ni->nk", normals[around], normals) > _SAME_SIDE
    )
    rows = trust[..., None] * np.stack([u, v, u * u, u * v, v * v], axis=-1)
    solved = np.linalg.pinv(rows, rcond=1e-3)[:, :2] * trust[:, None] / size[:, None]
    return around, tangents, solved.transpose(0, 2, 1)


class MapTables(eqx.Module):
    """The table in the precision of the splats, the mean over neighbors, the initial logits, and
    the change of logits per coordinate.
    """

    table: WeightTable
    mean: SurfaceMean
    start: Float[Array, "splats parameters"]
    steps: Float[Array, "splats parameters parameters"]


class ParameterMap(AbstractPart):
    r"""The material parameters at every splat, within the range of a table and no finer than
    `smoothness`.

        fraction = 1 / (1 + exp(-(logit(start) + blur(B x))))

    The fraction is the position of a value in the range of its parameter, on the parameter's scale.
    The blur is a Gaussian mean over the surface. `B` is the inverse square root of
    `J^T J / step^2 + 1 / deviation^2`, where `J` contains the derivatives, at the start, of the
    reflectance of a flat surface with respect to the logits, divided by the mean of the reflectance
    over the channels. A unit change of a coordinate therefore changes the color by about one step,
    and the coordinates are independent even if parameters have similar effects. A splat farther
    than 2.5 `smoothness` from all visible splats keeps its start.

    The part replaces `Splats.weights`. If the splats have an albedo, it must be known.

    **Attributes:**

    - `table`: the factors of the weights as a function of the parameters, for the Gaussians of the
      material.
    - `start`: values of each parameter by name, one per splat or one for all.
    - `smoothness`: standard deviation of the blur, mm. Static. Above half the spacing of the
      splats, maps become smoother and fits slower.
    - `deviation`: standard deviation of the normal prior of a logit about its start; 2 covers
      nearly the whole range. Static.
    - `step`: relative change of the color for a coordinate of 1. Static.

    **Raises:** `ValueError` for other names of parameters, and for a start outside the table.
    """

    shared = True
    table: WeightTable
    start: Mapping[str, Any]
    smoothness: float = eqx.field(static=True)
    deviation: float = eqx.field(static=True, default=2.0)
    step: float = eqx.field(static=True, default=0.02)

    def __check_init__(self):
        self.table.fractions(self.start)

    def check_material(self, material: Material) -> None:
        for name in ("variances", "weights"):
            ours, given = (
                np.asarray(getattr(gaussians, name), np.float64)
                for gaussians in (self.table.base, material.gaussians)
            )
            same = ours.shape == given.shape and np.allclose(ours, given, rtol=_SAME, atol=0)
            check_values(
                f"material.gaussians.{name}",
                float(same),
                "that of ParameterMap.table.base",
                lambda x: x == 1,
            )

    def prepared(self, splats: Splats) -> MapTables:
        table = jax.tree.map(lambda x: as_floats(np.asarray(x), splats.centers.dtype), self.table)
        fractions = np.asarray(table.fractions(self.start), np.float64).clip(BOUNDED, 1 - BOUNDED)
        logits = np.broadcast_to(
            np.log(fractions / (1 - fractions)), (splats.count, len(table.names))
        )
        start = jnp.asarray(logits, splats.centers.dtype)
        slopes = np.asarray(_reflectance_slopes(table, start), np.float64)
        information = np.swapaxes(slopes, 1, 2) @ slopes / self.step**2
        sizes, axes = np.linalg.eigh(information + np.eye(len(table.names)) / self.deviation**2)
        steps = (axes / np.sqrt(sizes)[:, None]) @ np.swapaxes(axes, 1, 2)
        steps = jnp.asarray(steps, start.dtype)
        return MapTables(table, SurfaceMean.of(splats, self.smoothness), start, steps)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "splats parameters"]:
        areas = pictured.splats.areas
        return jnp.zeros_like(areas, shape=(len(areas), len(self.table.names)))

    def moved(self, pictured: PicturedScene, x, prepared: MapTables) -> PicturedScene:
        weights = prepared.table.interpolate(self._fractions(x, prepared))
        return eqx.tree_at(
            lambda s: s.splats.weights, pictured, weights, is_leaf=lambda leaf: leaf is None
        )

    def prior_residuals(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return prepared.mean.gain / self.deviation * _changes(x, prepared)

    def maps(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return prepared.table.values(self._fractions(x, prepared))

    def _fractions(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return jax.nn.sigmoid(prepared.start + prepared.mean(_changes(x, prepared)))


def _changes(x: Float[Array, "splats parameters"], prepared: MapTables):
    """Compute the changes of logits before the blur."""
    return jnp.einsum("spq,sq->sp", prepared.steps, x)


@eqx.filter_jit
def _reflectance_slopes(
    table: WeightTable, logits: Float[Array, "splats parameters"]
) -> Float[Array, "splats channels parameters"]:
    """Differentiate the reflectance with respect to the logits, and divide by its mean over
    channels.
    """

    def reflectance(logits):
        return table.reflectance(jax.nn.sigmoid(logits)[None])[0]

    means = jnp.mean(jax.vmap(reflectance)(logits), axis=1)
    return jax.vmap(jax.jacfwd(reflectance))(logits) / means[:, None, None]
