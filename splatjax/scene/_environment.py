"""Environments: distant light given by an image of the whole sphere of directions."""

import functools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, DTypeLike, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values, numbers, record, require

from ._lights import AbstractExtendedLight, AbstractHighlight, AbstractLightSample, DistantStratum
from ._scene import Camera, Frame, rotation_by

_CELLS = 128  # per side of the equal-area grid that is divided into strata; a power of two
_EVEN = 0.1  # fraction of uniform importance, so that no direction is far from a sample
_FAINT = 1e-3  # fraction of the mean radiance added in computing a stratum's mean direction
_ROWS = 64  # height of the blurred maps; a pixel is as wide as the sharpest lobe
_ROUGHNESSES = np.geomspace(0.05, 1.0, 7)  # roughnesses of the blurred maps


@record
class EnvironmentLight(AbstractExtendedLight):
    r"""Distant light from all directions, given by an image.

        sky = EnvironmentLight(overcast_sky(), rotation=30, strength=0.5)
        place = io.load_environment("place.hdr", rotation=30)  # a file

    The image is a latitude-longitude map as OpenEXR defines it, with square pixels. The middle of
    the image is the front (+z), its left and right edges are the back (-z), and +x is halfway
    between the left edge and the middle. The upper edge is +y, the lower edge -y.

    The image is divided into `count` parts, and each part becomes one distant light with a shadow
    map: more parts give smoother shadows and take longer. Bright regions have more parts, but dark
    ones have some, so that no direction is far from a light. Highlights do not use the parts;
    glossy surfaces reflect the image, blurred by the lobe.

    **Attributes:**

    - `image`: radiance, linear; twice as wide as high, gray or in color. Differentiable; the
      boundaries of the parts are constants.
    - `rotation`: degrees about `up`; a positive angle turns +z towards +x. Differentiable.
    - `strength`: factor of each channel. Differentiable.
    - `up`: the direction of the image's upper edge, of any nonzero length. With (0, 0, 1), for a
      world with z up, the middle of the image is -y. Differentiable.
    - `directions`: world directions of the samples, of any nonzero length; or `None` to choose the
      samples by the image. The light of each pixel is distributed to the directions near it. The
      shadow maps are rendered along these directions, so the visibility that `splatjax.transfer`
      computes is exact for every image and rotation.
    - `count`: number of samples if the image chooses them. Static.
    - `cast_shadows`: whether the samples have shadow maps. Static.

    **Raises:** `ValueError` for an image that is not twice as wide as high, has an integer dtype,
    or contains negative or infinite radiance.
    """

    image: Float[Array, "height width #channels"] = eqx.field(
        converter=numbers, metadata={"linear": True}
    )
    rotation: Float[Array, ""] = eqx.field(converter=numbers, default=0.0)
    strength: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)
    up: Float[Array, "3"] = eqx.field(converter=numbers, default=(0.0, 1.0, 0.0))
    directions: Float[Array, "samples 3"] | None = eqx.field(converter=numbers, default=None)
    strength_field: ClassVar[str] = "strength"

    def __check_init__(self):
        height, width = getattr(self.image, "shape", (1, 2))[:2]
        require(
            width == 2 * height,
            f"EnvironmentLight.image has {height} rows and {width} columns; give a "
            "latitude-longitude map, twice as wide as high",
        )
        if isinstance(self.directions, jax.Array):
            name, lengths = "EnvironmentLight.directions", jnp.linalg.norm(self.directions, axis=-1)
            check_values(f"the number of {name}", lengths.size, "at least 1", lambda n: n >= 1)
            check_values(name, lengths, "not zero", lambda x: x > 0)

    def radiance(self) -> Float[Array, "height width channels"]:
        return self.image * self.strength[None, None]

    def to_world(self) -> Float[Array, "3 3"]:
        """Compute the rotation from image to world directions: a rotation about +y, then the
        shortest rotation from +y to `up`.
        """
        turn = rotation_by(jnp.deg2rad(self.rotation) * jnp.eye(3, dtype=self.up.dtype)[1])
        x, y, z = jnp.unstack(self.up / jnp.linalg.norm(self.up))
        is_down = (y < 0) & (x * x + z * z < 1e-12)  # rotate by half a turn about x
        x, z = jnp.where(is_down, 0.0, x), jnp.where(is_down, 1e-6, z)
        # 1 / (1 + y), without cancellation.
        lean = jnp.where(y < 0, 1 - y, 1.0) / jnp.where(y < 0, x * x + z * z, 1 + y)
        tilt = [1 - x * x * lean, x, -x * z * lean, -x, y, -z, -x * z * lean, z, 1 - z * z * lean]
        return jnp.stack(tilt).reshape(3, 3) @ turn

    @jit_unless_traced
    def stacked_samples(self) -> AbstractLightSample:
        directions, solid_angles = pixel_directions(len(self.image), self.image.dtype)
        brightness = jnp.mean(self.image, axis=-1)
        mean = jnp.sum(brightness * solid_angles) / (4 * jnp.pi)
        relative = brightness / jnp.where(mean > 0, mean, 1.0)
        moments = jnp.concatenate(
            [
                self.image * solid_angles[..., None],
                ((relative + _FAINT) * solid_angles)[..., None] * directions,
                jnp.stack([relative * solid_angles, solid_angles], axis=-1),
            ],
            axis=-1,
        )
        strata = (
            self._stratify(moments)
            if self.directions is None
            else self._distribute(directions, moments)
        )
        towards, irradiance = strata[:, -5:-2], strata[:, :-5] * self.strength[None]
        is_filled = jnp.sum(towards**2, axis=-1, keepdims=True) > 0
        towards = jnp.where(is_filled, towards, jnp.asarray([[0.0, 1.0, 0.0]], towards.dtype))
        towards = towards / jnp.linalg.norm(towards, axis=-1, keepdims=True) @ self.to_world().T
        return jax.vmap(
            lambda direction, irradiance, shadow_towards: DistantStratum(
                direction, irradiance, self.cast_shadows, shadow_towards
            )
        )(-towards, irradiance, self.directions)

    def _distribute(
        self, directions: Float[Array, "height width 3"], moments: Float[Array, "height width sums"]
    ) -> Float[Array, "samples sums"]:
        """Distribute the moments of every pixel to the given directions near it, by Gaussians half
        as wide as the spacing of the directions.
        """
        samples = self.directions / jnp.linalg.norm(self.directions, axis=1, keepdims=True)
        samples = samples @ self.to_world()
        concentration = len(samples) / jnp.pi  # of a Gaussian in the angle

        def of_row(row):
            towards, moments = row
            return jax.nn.softmax(concentration * towards @ samples.T, axis=1).T @ moments

        return jnp.sum(jax.lax.map(of_row, (directions, moments)), axis=0)

    def _stratify(self, moments: Float[Array, "height width sums"]) -> Float[Array, "strata sums"]:
        """Sum the moments over strata, which are segments of a Hilbert curve over the sphere."""
        # Sum over cells of equal area, in the order of the curve.
        height = len(moments)
        along = np.arange(2 * height) * _CELLS // (2 * height)
        middles = 0.5 * (1 - np.cos(np.pi * (np.arange(height) + 0.5) / height))
        down = (middles * _CELLS).astype(int)
        order = _hilbert_curve(_CELLS)[down[:, None], along[None]].reshape(-1)
        moments = moments.reshape(len(order), -1)
        cells = jnp.zeros((_CELLS**2, moments.shape[1]), moments.dtype).at[order].add(moments)

        # Divide the curve. A cell counts at most one stratum; otherwise the next one would be
        # empty.
        importance, even = jax.lax.stop_gradient(cells[:, -2:]).T
        importance = (1 - _EVEN) * importance + _EVEN * even
        for _ in range(8):
            importance = jnp.minimum(importance / jnp.sum(importance), 1 / self.count)
        middles = (jnp.cumsum(importance) - 0.5 * importance) / jnp.sum(importance)
        stratum = jnp.minimum((middles * self.count).astype(jnp.int32), self.count - 1)
        return jnp.zeros((self.count, cells.shape[1]), cells.dtype).at[stratum].add(cells)

    def highlight(self) -> "PrefilteredEnvironment":
        return PrefilteredEnvironment(prefilter(self.radiance()), self.to_world())

    def behind(self, frame: Frame, camera: Camera) -> Float[Array, "height width channels"]:
        """Composite the `beauty` of a frame over the environment behind it, for its camera."""
        sides = zip(reversed(frame.coverage.shape), camera.principal_pixel, strict=True)
        x, y = jnp.meshgrid(*(jnp.arange(n, dtype=self.image.dtype) + 0.5 - c for n, c in sides))
        z = jnp.broadcast_to(camera.focal_length * len(x), x.shape)
        sharp = PrefilteredEnvironment(_padded(self.radiance()[None]), self.to_world())
        seen = sharp.radiance(jnp.stack([x, y, z], axis=-1) @ camera.rotation, jnp.zeros_like(z))
        return frame.beauty + (1 - frame.coverage)[..., None] * seen


class PrefilteredEnvironment(AbstractHighlight):
    """The mean radiance of an environment over lobes of several roughnesses.

    **Attributes:**

    - `maps`: latitude-longitude maps, the sharpest first, padded at every edge by the adjacent
      pixel of the sphere.
    - `rotation`: rotates directions of the maps to directions in the world.

    **Source:** Karis 2013, "Real Shading in Unreal Engine 4" (split sum).
    """

    maps: Float[Array, "maps rows columns channels"]
    rotation: Float[Array, "3 3"]

    def reflected(self, points, mirrored, roughness, lobe, albedo):
        return jnp.moveaxis(self.radiance(mirrored, roughness), -1, 0) * albedo[None]

    def radiance(
        self, directions: Float[Array, "*points 3"], roughness: Float[Array, "..."]
    ) -> Float[Array, "*points channels"]:
        """Interpolate in the logarithm of the roughness and between pixels. At the poles the
        derivative with respect to the direction is set to 0.
        """
        x, y, z = jnp.unstack(directions @ self.rotation, axis=-1)
        apart = x * x + z * z > 1e-12
        x, z = jnp.where(apart, x, 0.0), jnp.where(apart, z, 1e-6)
        height = self.maps.shape[1] - 2
        row = jnp.arctan2(jnp.sqrt(x * x + z * z), y) * (height / jnp.pi) + 0.5
        column = (jnp.pi - jnp.arctan2(x, z)) * (height / jnp.pi) + 0.5
        lowest, highest = _ROUGHNESSES[[0, -1]].tolist()
        step = math.log(highest / lowest) / (len(_ROUGHNESSES) - 1)
        level = jnp.log(jnp.clip(roughness, lowest, highest) / lowest) / step
        places = [jnp.broadcast_to(level, row.shape), row, column]
        interpolate = functools.partial(map_coordinates, order=1, mode="nearest")
        return jax.vmap(interpolate, (-1, None), -1)(self.maps, places)


def even_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Compute directions evenly spread over the sphere along a Fibonacci spiral."""
    i = np.arange(count) + 0.5
    height, angle = 1 - 2 * i / count, np.pi * (5**0.5 - 1) * i
    across = np.sqrt(1 - height * height)
    return np.stack([across * np.cos(angle), height, across * np.sin(angle)], axis=1)


def pixel_directions(
    height: int, dtype: DTypeLike = float
) -> tuple[Float[Array, "height width 3"], Float[Array, "height width"]]:
    """Compute the directions of the pixels of a latitude-longitude map, +y up, and their solid
    angles.
    """
    latitude = jnp.pi * (0.5 - (jnp.arange(height, dtype=dtype) + 0.5) / height)
    longitude = jnp.pi * (1 - (jnp.arange(2 * height, dtype=dtype) + 0.5) / height)
    across, up = jnp.cos(latitude)[:, None], jnp.sin(latitude)[:, None]
    sine, cosine = jnp.sin(longitude)[None], jnp.cos(longitude)[None]
    directions = jnp.broadcast_arrays(across * sine, up, across * cosine)
    # The area of a strip of the sphere is proportional to its height, 2 sin(a / 2) cos(latitude).
    solid_angles = across * (2 * math.sin(0.5 * math.pi / height) * math.pi / height)
    return jnp.stack(directions, axis=-1), jnp.broadcast_to(solid_angles, (height, 2 * height))


@functools.cache
def _hilbert_curve(side: int) -> np.ndarray:
    """Number the cells of a square along a Hilbert curve. `side` is a power of two."""
    if side == 1:
        return np.zeros((1, 1), int)
    part, count = _hilbert_curve(side // 2), side * side // 4
    upper = [part.T, 3 * count + part.T[::-1, ::-1]]
    return np.block([upper, [count + part, 2 * count + part]])


def prefilter(
    radiance: Float[Array, "height width channels"],
) -> Float[Array, "maps _ _ channels"]:
    r"""Prefilter an environment by the specular lobe at normal incidence, for several roughnesses.

    The lobe at the angle `2 a` from the mirrored direction is
    `exp(-tan^2 a / m^2) cos 2a / cos^6 a`, divided by its integral. In longitude the filter is a
    circular convolution.
    """
    dtype, size = radiance.dtype, (_ROWS, 6 * _ROWS, radiance.shape[-1])
    # Three copies side by side, because the map is periodic.
    reduced = jax.image.resize(jnp.tile(radiance, (1, 3, 1)), size, "linear")
    reduced = reduced[:, 2 * _ROWS : 4 * _ROWS]
    _, solid_angles = pixel_directions(_ROWS, dtype)
    spectrum = jnp.fft.rfft(reduced * solid_angles[..., None], axis=1)

    polar = jnp.pi / _ROWS * (jnp.arange(_ROWS, dtype=dtype) + 0.5)
    turn = jnp.cos(jnp.pi / _ROWS * jnp.arange(2 * _ROWS, dtype=dtype))
    up, across = (factor[:, None] * factor[None] for factor in (jnp.cos(polar), jnp.sin(polar)))
    cosine = jnp.clip(up[..., None] + across[..., None] * turn[None, None], -0.99, 1.0)

    def blur(roughness):
        lobe = jnp.exp((cosine - 1) / ((1 + cosine) * roughness**2)) * jnp.maximum(cosine, 0)
        kernel = jnp.real(jnp.fft.rfft(lobe / (1 + cosine) ** 3, axis=2))
        blurred = jnp.einsum("rsf,sfk->rfk", kernel.astype(spectrum.dtype), spectrum)
        mass = kernel[:, :, 0] @ solid_angles[:, 0]
        return jnp.fft.irfft(blurred, axis=1) / mass[:, None, None]

    # The barrier prevents constant folding of all kernels by the compiler.
    maps = jax.lax.map(blur, jax.lax.optimization_barrier(jnp.asarray(_ROUGHNESSES, dtype)))
    return _padded(maps)


def _padded(maps: Float[Array, "maps rows columns channels"]) -> Float[Array, "maps _ _ channels"]:
    """Pad the maps by the adjacent pixels on the sphere."""
    half = maps.shape[2] // 2
    top, bottom = (jnp.roll(maps[:, row], half, axis=2) for row in (slice(1), slice(-1, None)))
    maps = jnp.concatenate([top, maps, bottom], axis=1)
    return jnp.concatenate([maps[:, :, -1:], maps, maps[:, :, :1]], axis=2)
