"""Smooth offsets of splats along their normals: a displacement map as a part of a scene."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Array, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values
from splatjax.geometry import tangent_frames
from splatjax.scene import Splats

from ._parts import AbstractPart, PicturedScene

_REACH = 2.5  # of the blur, standard deviations
_SLOPES = 17  # splats among which slopes are measured, itself included
# Tables have a multiple of this number of neighbors, so that similar bodies share a program.
_ROUNDED = 16
_SAME_SIDE = 0.3  # least cosine between normals of splats that belong together


class OffsetTables(eqx.Module):
    r"""The neighbors of each splat.

    **Attributes:**

    - `blurred`, `weights`: the neighbors over which its offset is averaged, and their weights.
    - `around`: the neighbors from which its slope is computed.
    - `slopes`: sums of values times these are derivatives along the `tangents`, exact for quadratic
      functions of them.
    - `gain`: root mean square of blurred noise of root mean square 1.
    """

    blurred: Int[Array, "splats _near"]
    weights: Float[Array, "splats _near"]
    around: Int[Array, "splats _around"]
    slopes: Float[Array, "splats _around 2"]
    tangents: Float[Array, "splats 2 3"]
    gain: Float[Array, ""]


class NormalOffsets(AbstractPart):
    r"""The offset of each splat along its initial normal: a displacement map, no finer than
    `smoothness`.

        offset = step blur(x),   center = start + offset normal

    The blur is a Gaussian mean over the surface, so an offset changes by no more than its
    coordinates do. Normals, areas and radii follow from the slopes of the offsets among the
    neighbors of each splat. A splat farther than 2.5 `smoothness` from all visible ones does not
    move.

    **Attributes:** (static)

    - `step`: mm.
    - `smoothness`: standard deviation of the blur, mm; some spacings of the splats. Finer bumps
      are not searched.
    - `deviation`: expected size of an offset, one standard deviation of a normal prior, mm.
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
        centers, normals, areas = (
            np.asarray(field, np.float64)
            for field in (splats.centers, splats.normals, splats.areas)
        )
        tree, dtype = scipy.spatial.KDTree(centers), splats.centers.dtype
        count = int(
            np.max(tree.query_ball_point(centers, _REACH * self.smoothness, return_length=True))
        )
        near, weights = _blur(
            tree, normals, areas, self.smoothness, -(-count // _ROUNDED) * _ROUNDED
        )
        around, tangents, slopes = _slopes(tree, normals)
        return OffsetTables(
            jnp.asarray(near, jnp.int32),
            jnp.asarray(weights, dtype),
            jnp.asarray(around, jnp.int32),
            jnp.asarray(slopes, dtype),
            jnp.asarray(tangents, dtype),
            jnp.asarray(np.sqrt(np.mean(np.sum(weights**2, axis=1))), dtype),
        )

    def coordinates(self, pictured: PicturedScene) -> Float[Array, " splats"]:
        return jnp.zeros_like(pictured.splats.areas)

    @jit_unless_traced
    def moved(
        self, pictured: PicturedScene, x: Float[Array, " splats"], prepared: OffsetTables
    ) -> PicturedScene:
        splats = pictured.splats
        offsets = self.step * jnp.sum(prepared.weights * x[prepared.blurred], axis=1)
        shifts = offsets[:, None] * splats.normals
        apart = shifts[prepared.around] - shifts[:, None]
        # The tangents of the start, and the slopes of the offsets along them.
        along = prepared.tangents + jnp.sum(prepared.slopes[..., None] * apart[:, :, None], axis=1)
        across = jnp.cross(along[:, 0], along[:, 1])
        stretch = jnp.sqrt(jnp.sum(across * across, axis=1))
        moved = (
            splats.centers + shifts,
            across / stretch[:, None],
            splats.areas * stretch,
            splats.radii * jnp.sqrt(stretch),
        )
        return eqx.tree_at(
            lambda s: (s.splats.centers, s.splats.normals, s.splats.areas, s.splats.radii),
            pictured,
            moved,
        )

    def prior(self, x: Float[Array, " splats"], prepared: OffsetTables) -> Float[Array, ""]:
        return jnp.sum((self.step * prepared.gain / self.deviation * x) ** 2)


def _blur(
    tree: "scipy.spatial.KDTree", normals: np.ndarray, areas: np.ndarray, width: float, count: int
):
    """Find neighbors and the weights of a mean over them; neighbors beyond reach and on another
    side of the body have weight 0.
    """
    distances, near = tree.query(
        tree.data, k=np.arange(1, count + 1), distance_upper_bound=_REACH * width, workers=-1
    )
    counts = near < len(areas)
    near = np.where(counts, near, np.arange(len(areas))[:, None])
    counts &= np.einsum("nki,ni->nk", normals[near], normals) > _SAME_SIDE
    blur = np.exp(-0.5 * (np.where(counts, distances, 0.0) / width) ** 2)
    weights = np.where(counts, blur * areas[near], 0.0)
    return near, weights / np.sum(weights, axis=1, keepdims=True)


def _slopes(tree: "scipy.spatial.KDTree", normals: np.ndarray):
    """Find neighbors, tangents, and the weights of derivatives along them: least squares with
    quadratic terms.
    """
    around = tree.query(tree.data, k=_SLOPES, workers=-1)[1][:, 1:]
    tangents = np.stack(tangent_frames(normals), axis=1)
    offsets = tree.data[around] - tree.data[:, None]
    u, v = np.einsum("nki,nai->ank", offsets, tangents)
    size = np.sqrt(np.mean(u * u + v * v, axis=1, keepdims=True))
    u, v = u / size, v / size
    trust = np.exp(-0.5 * (u * u + v * v)) * (
        np.einsum("nki,ni->nk", normals[around], normals) > _SAME_SIDE
    )
    rows = trust[..., None] * np.stack([u, v, u * u, u * v, v * v], axis=-1)
    solved = np.linalg.pinv(rows, rcond=1e-3)[:, :2] * trust[:, None] / size[:, None]
    return around, tangents, solved.transpose(0, 2, 1)
