"""Parts of a scene that may move, each in unbounded coordinates: albedo, lights, cameras, and
offsets of splats along their normals.
"""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Array, Float, Int, PyTree

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values
from splatjax.geometry import tangent_frames
from splatjax.scene import AbstractLight, Splats

from ._observation import PicturedScene

# An albedo moves between this and one less this: at 0 and 1 themselves the logit is infinite.
_BOUNDED = 1e-3
_PLACES = ("direction", "position", "origin")  # of lights
_REACH = 2.5  # of the blur, standard deviations
_SLOPES = 17  # splats among which slopes are measured, itself included
_ROUNDED = 16  # neighbors at a time, so that similar bodies share a program
_SAME_SIDE = 0.3  # least cosine between normals of splats that belong together


class AbstractPart(eqx.Module):
    r"""A part that may move. Its coordinates count steps from its start, where they are zero.

    **Attributes:** (of the class)

    - `shared`: whether all pictures share the part; else each has its own.
    """

    shared: ClassVar[bool] = False

    def __check_init__(self):
        for field in dataclasses.fields(self):
            check_values(
                f"{type(self).__name__}.{field.name}",
                getattr(self, field.name),
                "positive",
                lambda x: x > 0,
            )

    def prepared(self, splats: Splats) -> PyTree[Array]:
        """Compute data that depend only on the initial splats."""
        return None

    @abc.abstractmethod
    def coordinates(self, pictured: PicturedScene) -> PyTree[Array]:
        """Return the coordinates of the start: zeros. Raise `ValueError` without such a part."""

    @abc.abstractmethod
    def moved(
        self, pictured: PicturedScene, x: PyTree[Array], prepared: PyTree[Array]
    ) -> PicturedScene:
        """Apply coordinates to the part. Differentiable."""

    def prior(self, x: PyTree[Array], prepared: PyTree[Array]) -> Float[Array, ""] | float:
        """Compute the loss of the prior: squares of coordinates over their expected deviations."""
        return 0.0


class AlbedoMap(AbstractPart):
    r"""The albedo of every splat and channel, as a logit: it stays between 0 and 1.

        albedo = 1 / (1 + exp(-(logit(start) + step x)))

    **Attributes:** (static)

    - `step`: of the logit: 0.1 moves an albedo of 0.5 by 0.025.
    - `deviation`: expected distance of a logit from its start, one standard deviation of a normal
      prior. An invisible splat keeps its albedo; a hardly visible one nearly keeps it.

    Initial albedos are clamped to [0.001, 0.999].
    """

    shared = True
    step: float = eqx.field(static=True, default=0.1)
    deviation: float = eqx.field(static=True, default=3.0)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "splats channels"]:
        if pictured.splats.albedo is None:
            raise ValueError(
                "splats.albedo is None, and AlbedoMap needs a start; give a map, such as 0.5 "
                "everywhere"
            )
        return jnp.zeros_like(pictured.splats.albedo)

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        start = jnp.clip(pictured.splats.albedo, _BOUNDED, 1 - _BOUNDED)
        albedo = jax.nn.sigmoid(jax.scipy.special.logit(start) + self.step * x)
        return eqx.tree_at(lambda s: s.splats.albedo, pictured, albedo)

    def prior(self, x: Float[Array, "splats channels"], prepared: None) -> Float[Array, ""]:
        return jnp.sum((self.step / self.deviation * x) ** 2)


class LightStrengths(AbstractPart):
    """The strength of each light of each picture, channel by channel, as a logarithm: of
    irradiance, intensity or power.

    **Attributes:** (static)

    - `step`: of the logarithm: 0.05 is 5%.
    """

    step: float = eqx.field(static=True, default=0.05)

    def coordinates(self, pictured: PicturedScene) -> tuple[Float[Array, " channels"], ...]:
        for light in pictured.lights:
            if not light.strength_field:
                raise ValueError(
                    f"{type(light).__name__}.strength_field names no field that LightStrengths "
                    "can change"
                )
        return tuple(
            jnp.zeros_like(getattr(light, light.strength_field)) for light in pictured.lights
        )

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        def move(light: AbstractLight, steps: Array) -> AbstractLight:
            strength = getattr(light, light.strength_field) * jnp.exp(self.step * steps)
            return dataclasses.replace(light, **{light.strength_field: strength})

        return dataclasses.replace(pictured, lights=tuple(map(move, pictured.lights, x)))


class LightPlaces(AbstractPart):
    """The position of each light of each picture: directions rotate, and point lights and the
    origins of beams shift.

    **Attributes:** (static)

    - `turn`: a step of a direction, radians.
    - `shift`: a step of a position along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=0.02)
    shift: float = eqx.field(static=True, default=1.0)

    def coordinates(self, pictured: PicturedScene) -> tuple[dict[str, Float[Array, "3"]], ...]:
        return tuple(
            {name: jnp.zeros_like(getattr(light, name)) for name in _PLACES if hasattr(light, name)}
            for light in pictured.lights
        )

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        def move(light: AbstractLight, steps: dict[str, Array]) -> AbstractLight:
            places = {
                name: rotation(self.turn * step) @ getattr(light, name)
                if name == "direction"
                else getattr(light, name) + self.shift * step
                for name, step in steps.items()
            }
            return dataclasses.replace(light, **places)

        return dataclasses.replace(pictured, lights=tuple(map(move, pictured.lights, x)))


class CameraPoses(AbstractPart):
    r"""Position and rotation of each camera, which rotates around the middle of the splats, and
    shifts.

    A rotation around the body changes the visible side, and a shift the position of the body in the
    picture. Rotations around the pinhole would be nearly equivalent to shifts.

    **Attributes:** (static)

    - `turn`: a step of the rotation vector, radians.
    - `shift`: a step along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=2e-3)
    shift: float = eqx.field(static=True, default=0.2)

    def prepared(self, splats: Splats) -> Float[Array, "3"]:
        return jnp.mean(splats.centers, axis=0)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "2 3"]:
        return jnp.zeros((2, 3), pictured.camera.position.dtype)

    def moved(self, pictured: PicturedScene, x, prepared: Float[Array, "3"]) -> PicturedScene:
        middle, camera, turned = prepared, pictured.camera, rotation(self.turn * x[0])
        position = middle + turned @ (camera.position - middle) + self.shift * x[1]
        return eqx.tree_at(
            lambda s: (s.camera.position, s.camera.rotation),
            pictured,
            (position, camera.rotation @ turned.T),
        )


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Compute the rotation around a vector by its length, radians. Differentiable at 0, too.

        R = 1 + sin(t) / t [v] + (1 - cos t) / t^2 [v]^2,   t = |v|

    **Source:** Rodrigues 1840.
    """

    def sinc(y):  # sin(t) / t of y = t^2, near 0 by its series
        is_small = y < 1e-2
        t = jnp.sqrt(jnp.where(is_small, 1.0, y))
        return jnp.where(is_small, 1 - y / 6 * (1 - y / 20 * (1 - y / 42)), jnp.sin(t) / t)

    squared, identity = vector @ vector, jnp.eye(3, dtype=vector.dtype)
    cross = jnp.cross(identity, vector[None])
    return identity + sinc(squared) * cross + 0.5 * sinc(squared / 4) ** 2 * (cross @ cross)


class OffsetTables(eqx.Module):
    """The neighbors of each splat, and weights of sums over them."""

    blurred: Int[Array, "splats _near"]  # over which its offset is averaged
    around: Int[Array, "splats _around"]  # from which its slope is computed
    weights: Float[Array, "splats _near"]  # of the average
    slopes: Float[Array, "splats _around 2"]  # of derivatives, exact for quadratic functions
    tangents: Float[Array, "splats 2 3"]  # along which they are
    gain: Float[Array, ""]  # root mean square of blurred noise of root mean square 1


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
        fields = (splats.centers, splats.normals, splats.areas)
        centers, normals, areas = (np.asarray(field, np.float64) for field in fields)
        tree = scipy.spatial.KDTree(centers)
        blurred, weights = _blur(tree, normals, areas, self.smoothness)
        around, tangents, slopes = _slopes(tree, normals)
        gain = np.sqrt(np.mean(np.sum(weights**2, axis=1)))
        indices = (jnp.asarray(neighbors, jnp.int32) for neighbors in (blurred, around))
        values = (weights, slopes, tangents, gain)
        return OffsetTables(
            *indices, *(jnp.asarray(value, splats.centers.dtype) for value in values)
        )

    def coordinates(self, pictured: PicturedScene) -> Float[Array, " splats"]:
        return jnp.zeros_like(pictured.splats.areas)

    @jit_unless_traced
    def moved(self, pictured: PicturedScene, x, prepared: OffsetTables) -> PicturedScene:
        splats = pictured.splats
        offsets = self.step * jnp.sum(prepared.weights * x[prepared.blurred], axis=1)
        shifts = offsets[:, None] * splats.normals
        apart = shifts[prepared.around] - shifts[:, None]
        # The tangents of the start, and the slopes of the offsets along them.
        along = prepared.tangents + jnp.sum(prepared.slopes[..., None] * apart[:, :, None], axis=1)
        across = jnp.cross(along[:, 0], along[:, 1])
        stretch = jnp.sqrt(jnp.sum(across * across, axis=1))
        centers, normals = splats.centers + shifts, across / stretch[:, None]
        return eqx.tree_at(
            lambda s: (s.splats.centers, s.splats.normals, s.splats.areas, s.splats.radii),
            pictured,
            (centers, normals, splats.areas * stretch, splats.radii * jnp.sqrt(stretch)),
        )

    def prior(self, x: Float[Array, " splats"], prepared: OffsetTables) -> Float[Array, ""]:
        return jnp.sum((self.step * prepared.gain / self.deviation * x) ** 2)


def _blur(tree: "scipy.spatial.KDTree", normals: np.ndarray, areas: np.ndarray, width: float):
    """Find neighbors and the weights of a mean over them; neighbors beyond reach and on another
    side of the body have weight 0.
    """
    reach = _REACH * width
    most = int(np.max(tree.query_ball_point(tree.data, reach, return_length=True)))
    order = np.arange(1, -(-most // _ROUNDED) * _ROUNDED + 1)
    distances, near = tree.query(tree.data, k=order, distance_upper_bound=reach, workers=-1)
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
