"""Parts of a scene that may move, each in unbounded coordinates."""

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
from splatjax.scene import AbstractLight, Camera, Material, Scene, Splats

# An albedo moves between this and one less this: at 0 and 1 themselves the logit is infinite.
_BOUNDED = 1e-3


class Setup(eqx.Module):
    """The splats of a picture, its camera and its lights."""

    splats: Splats
    camera: Camera
    lights: tuple[AbstractLight, ...]

    def scene(self, material: Material) -> Scene:
        return Scene(self.splats, self.lights, material)


class AbstractPart(eqx.Module):
    r"""A part that may move. Its coordinates count steps from its start, where they are zero.

    An optimizer sees coordinates in steps, so that one learning rate serves all parts: Adam at a
    rate of 1 moves each by up to one step at a time.
    """

    shared: ClassVar[bool] = False
    """Whether all pictures share the part; else each has its own."""

    def __check_init__(self):
        for field in dataclasses.fields(self):
            check_values(
                f"{type(self).__name__}.{field.name}",
                getattr(self, field.name),
                "positive",
                lambda x: x > 0,
            )

    def prepared(self, splats: Splats) -> PyTree[Array]:
        """Compute what depends on the splats at the start alone."""
        return None

    @abc.abstractmethod
    def coordinates(self, setup: Setup) -> PyTree[Array]:
        """Return the coordinates of the start: zeros. Raise `ValueError` without such a part."""

    @abc.abstractmethod
    def moved(self, setup: Setup, x: PyTree[Array], prepared: PyTree[Array]) -> Setup:
        """Move the part to coordinates. Differentiable."""

    def prior(self, x: PyTree[Array], prepared: PyTree[Array]) -> Float[Array, ""] | float:
        """Compute what the prior adds to the loss: squares of the coordinates over their expected
        deviations.
        """
        return 0.0


class AlbedoMap(AbstractPart):
    r"""The albedo of every splat and channel, as a logit: it stays between 0 and 1.

        albedo = 1 / (1 + exp(-(logit(start) + step x)))

    **Attributes:** (static)

    - `step`: of the logit: 0.1 moves an albedo of 0.5 by 0.025.
    - `deviation`: how far from the start a logit is expected, one standard deviation of a normal
      prior. A splat that no picture shows keeps its albedo; one that they hardly show keeps nearly
      its albedo.

    Albedos that start below 0.001 or above 0.999 start there.
    """

    shared = True
    step: float = eqx.field(static=True, default=0.1)
    deviation: float = eqx.field(static=True, default=3.0)

    def coordinates(self, setup: Setup) -> Float[Array, "splats channels"]:
        if setup.splats.albedo is None:
            raise ValueError(
                "splats.albedo is None, and AlbedoMap has nothing to move: start from a map, such "
                "as 0.5 everywhere"
            )
        return jnp.zeros_like(setup.splats.albedo)

    def moved(self, setup: Setup, x: Float[Array, "splats channels"], prepared: None) -> Setup:
        start = jnp.clip(setup.splats.albedo, _BOUNDED, 1 - _BOUNDED)
        albedo = jax.nn.sigmoid(jax.scipy.special.logit(start) + self.step * x)
        return eqx.tree_at(lambda s: s.splats.albedo, setup, albedo)

    def prior(self, x: Float[Array, "splats channels"], prepared: None) -> Float[Array, ""]:
        return jnp.sum((self.step / self.deviation * x) ** 2)


class LightStrengths(AbstractPart):
    """The strength of each light of each picture, channel by channel, as a logarithm: of
    irradiance, intensity or power.

    **Attributes:** (static)

    - `step`: of the logarithm: 0.05 is 5%.
    """

    step: float = eqx.field(static=True, default=0.05)

    def coordinates(self, setup: Setup) -> tuple[Float[Array, " channels"], ...]:
        for light in setup.lights:
            if not light.strength:
                raise ValueError(
                    f"{type(light).__name__}.strength names no field that LightStrengths may move"
                )
        return tuple(jnp.zeros_like(getattr(light, light.strength)) for light in setup.lights)

    def moved(self, setup: Setup, x, prepared) -> Setup:
        def move(light: AbstractLight, steps: Array) -> AbstractLight:
            strength = getattr(light, light.strength) * jnp.exp(self.step * steps)
            return dataclasses.replace(light, **{light.strength: strength})

        return dataclasses.replace(setup, lights=tuple(map(move, setup.lights, x)))


class LightPlaces(AbstractPart):
    """The place of each light of each picture: directions turn, and point lights and the origins of
    beams shift.

    **Attributes:** (static)

    - `turn`: a step of a direction, radians.
    - `shift`: a step of a position along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=0.02)
    shift: float = eqx.field(static=True, default=1.0)

    def coordinates(self, setup: Setup) -> tuple[dict[str, Float[Array, "3"]], ...]:
        return tuple(
            {
                name: jnp.zeros_like(getattr(light, name))
                for name in ("direction", "position", "origin")
                if hasattr(light, name)
            }
            for light in setup.lights
        )

    def moved(self, setup: Setup, x, prepared) -> Setup:
        def move(light: AbstractLight, steps: dict[str, Array]) -> AbstractLight:
            places = {
                name: rotation(self.turn * step) @ getattr(light, name)
                if name == "direction"
                else getattr(light, name) + self.shift * step
                for name, step in steps.items()
            }
            return dataclasses.replace(light, **places)

        return dataclasses.replace(setup, lights=tuple(map(move, setup.lights, x)))


class CameraPoses(AbstractPart):
    r"""Position and rotation of each camera: it turns around the middle of the splats, and shifts.

    A turn around the body changes which side is seen, a shift where the body is in the picture: the
    two are not mistaken for each other, as they would be in turns around the pinhole.

    **Attributes:** (static)

    - `turn`: a step of the rotation vector, radians.
    - `shift`: a step along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=2e-3)
    shift: float = eqx.field(static=True, default=0.2)

    def prepared(self, splats: Splats) -> Float[Array, "3"]:
        return jnp.mean(splats.centers, axis=0)

    def coordinates(self, setup: Setup) -> Float[Array, "2 3"]:
        return jnp.zeros((2, 3), setup.camera.position.dtype)

    def moved(self, setup: Setup, x, prepared: Float[Array, "3"]) -> Setup:
        middle, camera, turned = prepared, setup.camera, rotation(self.turn * x[0])
        position = middle + turned @ (camera.position - middle) + self.shift * x[1]
        pose = position, camera.rotation @ turned.T
        return eqx.tree_at(lambda s: (s.camera.position, s.camera.rotation), setup, pose)


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Compute the rotation around a vector by its length, radians. Differentiable at 0, too.

        R = 1 + sin(t) / t [v] + (1 - cos t) / t^2 [v]^2,   t = |v|

    **Source:** Rodrigues 1840.
    """
    squared = jnp.sum(vector * vector)
    near = squared < 1e-2
    t = jnp.sqrt(jnp.where(near, 1.0, squared))
    first = jnp.where(
        near, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), jnp.sin(t) / t
    )
    second = jnp.where(
        near, 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), (1 - jnp.cos(t)) / t**2
    )
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
    return jnp.eye(3, dtype=vector.dtype) + first * cross + second * (cross @ cross)


_REACH = 2.5  # of the blur, standard deviations
_SLOPES = 17  # splats among which slopes are measured, itself included
# Tables hold a multiple of so many neighbors: one program serves bodies that are nearly alike.
_ROUNDED = 16
_SAME_SIDE = 0.3  # least cosine between normals of splats that belong together


class OffsetTables(eqx.Module):
    r"""The neighbors of each splat.

    **Attributes:**

    - `blurred`, `weights`: those that its offset is blurred over, and the weights of their mean.
    - `around`: those among which its slope is measured.
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
    r"""The distance that each splat has moved along its normal at the start: a displacement map, no
    finer than `smoothness`.

        offset = step blur(x),   center = start + offset normal

    The blur is a Gaussian over the surface that takes means, so that an offset moves by no more
    than its coordinates do. Normals, areas and radii follow from the slopes of the offsets among
    the neighbors of each splat: a bump is lit by its normals. A splat farther than 2.5 `smoothness`
    from all that the pictures show stays exactly where it is.

    **Attributes:** (static)

    - `step`: mm.
    - `smoothness`: standard deviation of the blur, mm; some spacings of the splats. Finer bumps
      are not searched.
    - `deviation`: how large an offset is expected to be, one standard deviation of a normal prior,
      mm.
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
        gain = np.sqrt(np.mean(np.sum(weights**2, axis=1)))
        return OffsetTables(
            jnp.asarray(near, jnp.int32),
            jnp.asarray(weights, dtype),
            jnp.asarray(around, jnp.int32),
            jnp.asarray(slopes, dtype),
            jnp.asarray(tangents, dtype),
            jnp.asarray(gain, dtype),
        )

    def coordinates(self, setup: Setup) -> Float[Array, " splats"]:
        return jnp.zeros_like(setup.splats.areas)

    @jit_unless_traced
    def moved(self, setup: Setup, x: Float[Array, " splats"], prepared: OffsetTables) -> Setup:
        splats = setup.splats
        offsets = self.step * jnp.sum(prepared.weights * x[prepared.blurred], axis=1)
        shifts = offsets[:, None] * splats.normals
        apart = shifts[prepared.around] - shifts[:, None]
        # The tangents of the start, and how the offsets of the splats change along them.
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
            setup,
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
