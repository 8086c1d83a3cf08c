"""The default body: a bust with closed eyes and the colors of skin.

The shape, `profiles/bust.npz`, was made for splatjax and has the same license. It is the zero level
of a signed distance function, meshed to within 0.06 mm. The colors are formulas.
"""

import numpy as np
from jaxtyping import Float

from splatjax._library import profiles_folder
from splatjax._smooth import smooth_step
from splatjax.cache import kept
from splatjax.scene import Splats

from ._mesh import Mesh, unit, vertex_normals
from ._sample import sample_mesh

_STEP, _TILT = 0.01, 0.002  # units of positions (mm) and of normals in the file
_MIDDLE = np.asarray([0.0, -30.0, -10.0])


def bust_mesh() -> Mesh:
    r"""Read a life-size head with neck and shoulders as a closed mesh, in mm, with +y up, facing
    +z, eyes near y = 0.

    **Returns:** the mesh, with normals and texture coordinates: u is the longitude around the
    vertical axis (0.5 at the face, the seam at the back), and v is the angle from the bottom, both
    about a point inside the head.
    """
    with np.load(profiles_folder() / "bust.npz") as file:
        steps, corners, tilts = (file[name].astype(int) for name in ("steps", "corners", "tilts"))
    # Vertices are stored as differences, in the order in which faces first use them.
    vertices = _STEP * np.cumsum(steps, axis=0)
    # A corner is 0 for a new vertex, and k for the k-th last of the vertices so far.
    faces = (np.cumsum(corners == 0) - np.maximum(corners, 1)).reshape(-1, 3)
    # Normals are stored as tilts from the mean normal of the surrounding faces.
    normals = unit(vertex_normals(vertices, faces) + _TILT * tilts)
    x, y, z = np.moveaxis(vertices[faces] - _MIDDLE, -1, 0)
    u = np.arctan2(x, z) / (2 * np.pi) + 0.5
    u = np.where((np.ptp(u, axis=1) > 0.5)[:, None] & (u < 0.5), u + 1, u)
    v = 1 - np.arctan2(np.hypot(x, z), y) / np.pi
    return Mesh(vertices, faces, normals, np.stack([u, v], axis=-1))


@kept
def bust(count: int = 200_000, *, seed: int = 0) -> Splats:
    r"""Sample splats from the built-in bust, 33 cm tall, in the colors of skin.

    **Arguments:**

    - `count`: number of splats, at least 1.
    - `seed`: seed of the random positions; the same seed gives the same splats.

    **Returns:** splats with albedo, specular and roughness, in mm, JAX's default precision and
    Morton order. Their areas sum to the area of the mesh. `splatjax.geometry.sample_mesh` describes
    their distribution.

    **Raises:** `ValueError` if `count` is below 1.
    """
    splats = sample_mesh(bust_mesh(), count, seed=seed, rounded=True, relaxations=2)
    colors = complexion(np.asarray(splats.centers, np.float64))
    return Splats(splats.centers, splats.normals, splats.radii, splats.areas, *colors)


_SKIN = np.asarray([0.60, 0.375, 0.285])
_BLOOD = np.asarray([1.0, 0.70, 0.68])  # factor of each channel for more blood below the skin
_LIPS = np.asarray([0.50, 0.205, 0.185])
_HAIR = np.asarray([0.15, 0.095, 0.07])
_SCALP = np.asarray([0.47, 0.335, 0.285])


def complexion(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Compute the linear albedo, in (0, 1), and the factors of specular strength and roughness at
    points of the bust (mm).
    """
    x, y, z = points.T
    side, front = np.abs(x), smooth_step(z, 20, 60)
    lips, oily = _lips(side, y, z), bump(x, 0, 26) * smooth_step(y, -60, -10) * front
    blood = (
        0.6 * bump(side, 44, 18) * bump(y, -26, 17) * front  # cheeks
        + 0.6 * bump(x, 0, 15) * bump(y, -40, 15) * smooth_step(z, 78, 104)  # nose
        + 0.25 * bump(x, 0, 18) * bump(y, -98, 12) * front  # chin
        + 0.9 * smooth_step(side, 72, 84) * bump(y, -10, 42) * bump(z, -14, 34)  # ears
        + 0.35 * bump(side, 31, 17) * bump(y, -3, 10) * smooth_step(z, 55, 66)  # lids
        + 0.10 * _mottling(points, 17.0, 3)
        + 0.07 * _mottling(points, 5.0, 5)
    )
    spots = 1 + 0.02 * _mottling(points, 28.0, 7) + 0.025 * _mottling(points, 2.2, 11)
    albedo = _SKIN * _BLOOD ** np.clip(blood, -0.5, 1.6)[:, None] * spots[:, None]
    stubble = 0.55 * _scalp(x, y, z) * (1 + 0.12 * _mottling(points, 1.6, 13))
    for color, share in (
        (_SCALP, stubble),
        (_LIPS, 0.95 * lips),
        (_HAIR, 0.85 * _brows(points, side, y, z)),
        (_HAIR, 0.8 * _lashes(side, y, z)),
    ):
        share = np.clip(share, 0.0, 1.0)[:, None]
        albedo = albedo * (1 - share) + color * share
    specular = 1 + 0.25 * oily + 0.5 * lips + 0.12 * _mottling(points, 2.2, 17)
    return np.clip(albedo, 0.01, 0.95), specular, 1 - 0.15 * oily - 0.3 * lips


def bump(x, center, width):
    """Compute `exp(-(x - center)^2 / width^2)`."""
    return np.exp(-(((x - center) / width) ** 2))


def _scalp(x, y, z):
    """Compute a mask of the shaven scalp, down to the hairline."""
    behind = smooth_step(z, 62, 44) * smooth_step(y, 44, 62)
    temples = smooth_step(z, 16, 2) * smooth_step(y, 2, 24)
    nape = smooth_step(z, -42, -60) * smooth_step(y, -62, -40)
    return np.maximum(np.maximum(behind, temples), nape)


def _lips(side, y, z):
    upper = -59.8 - 0.30 * smooth_step(side, 4, 26) * 26 * 0.9 - 0.9 * bump(side, 0, 2.5)
    lower = -78.2 + 9.6 * (np.minimum(side, 27) / 27) ** 2
    inside = smooth_step(y, upper + 0.9, upper - 0.9) * smooth_step(y, lower - 1.1, lower + 1.1)
    return inside * smooth_step(side, 26, 23) * smooth_step(z, 60, 68)


def _brows(points, side, y, z):
    """Compute a mask of the brows: an arch with single hairs."""
    rise = np.sin(np.clip((side - 12) / 44, 0, 1) * np.pi * 0.62)
    arch = 25.5 + 6.0 * rise - 0.16 * np.maximum(side - 42, 0)
    across = bump(y, arch, 4.4 - 0.06 * np.clip(side - 14, 0, 42)) * smooth_step(z, 30, 45)
    hairs = 0.5 + 0.5 * np.sin(3.1 * side + 2.2 * (y - arch) + 2.0 * _mottling(points, 2.5, 19))
    return across * smooth_step(side, 9, 17) * smooth_step(side, 57, 46) * (0.65 + 0.35 * hairs)


def _lashes(side, y, z):
    across = side - 31
    lid = bump(y, -6.5 + 0.012 * across**2 - 0.02 * across - 0.6, 0.9)
    return lid * smooth_step(np.abs(across), 17, 13) * smooth_step(z, 55, 62)


def _mottling(points: Float[np.ndarray, "n 3"], size: float, seed: int) -> Float[np.ndarray, " n"]:
    """Compute smooth noise of about unit variance with patches of a given size, mm, as a sum of 16
    waves in random directions.
    """
    random = np.random.default_rng(seed)
    directions = random.normal(size=(3, 16))
    directions *= (np.pi / size) * random.uniform(0.4, 1.6, 16) / np.linalg.norm(directions, axis=0)
    phases = random.uniform(0, 2 * np.pi, 16).astype(np.float32)
    waves = points.astype(np.float32) @ directions.astype(np.float32) + phases
    return np.sin(waves).sum(axis=1) * np.float32(np.sqrt(2 / 16))
