"""A procedural bust with the colors of skin, the default body.

Its head is modeled in clay: serene, eyes closed; mm, +y up, facing +z, eyes near y = 0.
"""

import numpy as np
from jaxtyping import Float

from splatjax._smooth import smooth_step
from splatjax.cache import kept
from splatjax.scene import Splats

from ._clay import Part, above, bump, carve, ellipsoid, join, keep, limb, model, surface_nets
from ._mesh import Mesh
from ._sample import splats_at
from ._scatter import scatter

LOW, HIGH = (-140.0, -226.0, -125.0), (140.0, 124.0, 125.0)
# Where a primitive lies: as it is, on both sides, or on both without a crease down the middle.
_ONE, _BOTH, _BLUNT = range(3)
_SKULL: Part = [
    (ellipsoid, _ONE, (0, 40, -14), (75, 73, 90)),
    (join, 20, (ellipsoid, _ONE, (0, 36, -40), (75, 62, 64))),
    (join, 24, (ellipsoid, _ONE, (0, 44, 20), (62, 58, 62))),
    (join, 16, (ellipsoid, _BOTH, (47, 4, 26), (15, 24, 26))),
]
_JAW: Part = [
    (limb, _BOTH, (42, -58, -4), (13, -95, 61), 14, 14),
    (join, 14, (ellipsoid, _ONE, (0, -97, 66), (19, 15, 17))),
]
_FACE: Part = [
    (ellipsoid, _ONE, (0, -30, 16), (57, 78, 62)),
    (join, 28, _JAW),
    (join, 22, (ellipsoid, _BOTH, (40, -42, 22), (21, 36, 34))),
]
_HEAD: Part = [
    _SKULL,
    (join, 24, _FACE),
    (join, 24, (limb, _BOTH, (43, -19, 55), (63, -12, 6), 12, 8)),  # cheekbones
]
_TORSO: Part = [
    (limb, _ONE, (0, -40, -36), (0, -205, -44), 49, 54),  # neck
    (join, 26, (ellipsoid, _ONE, (0, -28, -55), (50, 42, 36))),
    (join, 26, (limb, _BLUNT, (52, -42, -30), (20, -190, 2), 9, 9)),  # cords
    (join, 16, (ellipsoid, _ONE, (0, -132, 3), (12, 17, 9))),
    (join, 44, (limb, _BLUNT, (22, -140, -50), (118, -208, -48), 30, 30)),  # shoulders
    (join, 40, (ellipsoid, _ONE, (0, -232, -28), (128, 62, 60))),  # chest
    (keep, 14, (ellipsoid, _ONE, (0, -150, -34), (122, 110, 94))),
    (keep, 10, (above, _ONE, -214)),
]
_BROW: Part = [
    (limb, _BOTH, (8, 21, 78.5), (36, 27, 71), 7, 7),
    (join, 10, (limb, _BOTH, (36, 27, 71), (52, 13, 48), 7, 6)),
    (join, 8, (limb, _ONE, (-10, 21, 78), (10, 21, 78), 7, 7)),
]
_NOSE: Part = [
    (limb, _ONE, (0, 12, 77), (0, -34, 100), 6.5, 7),
    (join, 10, (limb, _ONE, (0, 4, 70), (0, -38, 86), 9, 14.5)),
    (join, 8, (ellipsoid, _ONE, (0, -37, 101), (9.5, 8.8, 9.5))),
    (join, 5, (ellipsoid, _BOTH, (13, -41.5, 91), (6, 7.2, 9.5))),
    (join, 4, (limb, _ONE, (0, -46, 84), (0, -43.5, 101), 4.6, 4.2)),
]
_FEATURES = [
    (join, 16, _BROW),
    (join, 20, (limb, _BOTH, (51, 12, 47), (48, -14, 54), 6, 8)),  # rims of the sockets
    (carve, 14, (ellipsoid, _BOTH, (30, 3, 88), (19, 13, 17))),  # sockets
    (join, 22, (ellipsoid, _ONE, (0, -60, 56), (31, 27, 31))),  # muzzle
    (join, 9, _NOSE),
    (carve, 2, (limb, _BOTH, (8.2, -50.5, 94.5), (7.0, -41, 93), 2.6, 1.6)),  # nostrils
]
_UPPER_LIP: Part = [
    (limb, _BOTH, (4.5, -62.8, 84.5), (24.5, -67.2, 74), 4.6, 2.0),
    (join, 3, (ellipsoid, _ONE, (0, -65.2, 85.5), (6, 4, 4.6))),
]
_LOWER_LIP: Part = [
    (limb, _BOTH, (6, -72.2, 82.4), (23, -68.3, 75), 5, 2.2),
    (join, 5, (ellipsoid, _ONE, (0, -72.6, 82.6), (13, 5.3, 6))),
]


def head_distance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the signed distance to the bust, to first order; single precision, as the points
    are.
    """
    x, y, z = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    side = np.abs(x)
    body = model(
        [_HEAD, (join, 30, _TORSO)],
        [(x, y, z), (side, y, z), (np.sqrt(x * x + 144), y, z)],
    )
    near = np.flatnonzero((z > 25) & (y > -125) & (y < 60) & (side < 75))
    if len(near):
        body[near] = _face(body[near], x[near], y[near], z[near], side[near])
    near = np.flatnonzero((side > 48) & (y > -65) & (y < 45) & (z > -65) & (z < 45))
    if len(near):
        body[near] = _ear(body[near], y[near], z[near], side[near])
    return body


def _face(body, x, y, z, side):
    views = [(x, y, z), (side, y, z)]
    body = _eyes(model([body, *_FEATURES], views), y, z, side)
    body = model([body, (join, 3.2, _UPPER_LIP), (join, 3.2, _LOWER_LIP)], views)
    parting = -67.9 + 0.9 * bump(side, 7, 5) - 0.9 * bump(side, 0, 5)
    reach = smooth_step(side, 29, 23) * smooth_step(z, 60, 72)
    body = body + reach * 2.2 * bump(y, parting, 1.3)
    front = smooth_step(z, 55, 70)
    body = body + front * 1.4 * bump(x, 0, 3.6) * bump(y, -54.5, 6)
    body = body - front * 0.8 * bump(side, 5, 2.6) * bump(y, -55.5, 6)
    return body + front * 2.6 * bump(x, 0, 17) * bump(y, -81, 5.5)


def _eyes(body, y, z, side):
    """Closed lids that part along a curve, and the fold above them."""
    across = side - 31
    parting = -6.5 + 0.012 * across**2 - 0.02 * across
    open_span = smooth_step(np.abs(across), 17, 12)
    lids = ellipsoid((side, y, z), (31, -1, 61.5), (17, 14, 15))
    upper = smooth_step(y - parting, -0.6, 0.6)
    lids = lids - 1.3 * open_span * upper * bump(y - parting, 0.0, 7.0)
    lids = lids + 0.9 * open_span * bump(y, parting - 0.5, 0.8)
    body = join(body, lids, 6)
    fold = 7.2 - 0.018 * across**2
    front = smooth_step(z, 58, 68)
    return body + front * 1.3 * bump(y, fold, 1.9) * smooth_step(np.abs(across), 18, 11)


def _ear(body, y, z, side):
    """A pinna that stands off the head, thin enough for light to come through."""
    turn, lean = np.radians(24), np.radians(12)
    a, b, c = side - 69, y + 9, z + 8
    back = a * np.sin(turn) - c * np.cos(turn)
    out = a * np.cos(turn) + c * np.sin(turn)
    s = back * np.cos(lean) - b * np.sin(lean) - 9
    t = back * np.sin(lean) + b * np.cos(lean)
    half_width = 17.5 + 0.13 * t
    inward = (1 - np.sqrt((s / half_width) ** 2 + (t / 32) ** 2)) * 18  # mm from the outline, about
    sheet = out - 5 + 3.0 * smooth_step(inward, 2, 13)
    pinna = keep(np.abs(sheet) - 1.5, -inward, 2)
    spared = smooth_step(t, -22, -10)
    helix = np.sqrt((inward - 2.2) ** 2 + (sheet - 1.9) ** 2) - 2.7 * (0.55 + 0.45 * spared)
    ridge = np.sqrt((s / (half_width * 0.56) - 0.05) ** 2 + ((t + 1) / 19) ** 2)
    anti = np.sqrt(((1 - ridge) * 10) ** 2 + (sheet - 1.6) ** 2) - 2.1 + 6 * smooth_step(s, -1, -5)
    lobe = (ellipsoid, _ONE, (-2, -27, 4.5), (8.5, 7.5, 2.6))
    parts = [
        [body, (join, 10, (ellipsoid, _ONE, (-7, -3, -5), (12, 20, 8)))],  # and the root
        (join, 4, [pinna, (join, 2, helix), (join, 3, anti), (join, 4, lobe)]),
        (carve, 3, (ellipsoid, _ONE, (-3.5, -4, 7), (8.5, 12.5, 7.5))),  # concha
        (join, 3, (ellipsoid, _ONE, (-11.5, -7, 4.5), (4, 5.5, 3))),  # tragus
    ]
    return model(parts, [(s, t, out)])


_MIDDLE = np.asarray([0.0, -30.0, -10.0])


def bust_mesh(*, spacing: float = 1.4) -> Mesh:
    r"""Make a head with neck and shoulders as a closed mesh, life-size: mm, +y up, facing +z, eyes
    near y = 0.

    **Arguments:**

    - `spacing`: of the grid of the mesh, mm: about the length of its edges, from 0.5 to 1.6.

    **Returns:** the mesh, with normals and texture coordinates: u is the longitude around the
    vertical axis (0.5 the face, the seam at the back), v the angle from the bottom, both seen from
    a point inside the head.

    **Raises:** `ValueError` for another spacing.
    """
    if not 0.5 <= spacing <= 1.6:
        raise ValueError(
            f"spacing is {spacing}; it must lie between 0.5 and 1.6 mm, or the ears grow onto the "
            "head"
        )
    mesh = surface_nets(head_distance, LOW, HIGH, spacing)
    x, y, z = np.moveaxis(mesh.corners() - _MIDDLE, -1, 0)
    u = np.arctan2(x, z) / (2 * np.pi) + 0.5
    u = np.where((np.ptp(u, axis=1) > 0.5)[:, None] & (u < 0.5), u + 1, u)
    v = 1 - np.arctan2(np.hypot(x, z), y) / np.pi
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, np.stack([u, v], axis=-1))


@kept
def bust(count: int = 200_000, *, seed: int = 0) -> Splats:
    r"""Make the bust as splats, in the colors of skin.

    **Arguments:**

    - `count`: number of splats, at least 1.
    - `seed`: of the random positions; the same seed gives the same splats.

    **Returns:** splats in Morton order with albedo, specular and roughness, in JAX's default
    precision; their areas add up to that of the mesh. `splatjax.geometry.sample_mesh` describes
    their distribution.

    **Raises:** `ValueError` when `count` is below 1.
    """
    mesh = bust_mesh()
    points = scatter(mesh, count, seed=seed, relaxations=2)
    splats = splats_at(mesh, points)
    return Splats(
        splats.centers,
        splats.normals,
        splats.radii,
        splats.areas,
        *complexion(points.positions(mesh)),
    )


_SKIN = np.asarray([0.60, 0.375, 0.285])
_BLOOD = np.asarray([1.0, 0.70, 0.68])  # what more blood below the skin takes from each channel
_LIPS = np.asarray([0.50, 0.205, 0.185])
_HAIR = np.asarray([0.15, 0.095, 0.07])
_SCALP = np.asarray([0.47, 0.335, 0.285])


def complexion(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return linear albedo in (0, 1), and the factors on specular strength and roughness, at points
    of the bust (mm).
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


def _scalp(x, y, z):
    """A shaven scalp, down to the hairline."""
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
    """Brows: an arch, with single hairs along it."""
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
    """Compute smooth noise of about unit variance whose patches are of the given size, mm: 16 waves
    in random directions.
    """
    random = np.random.default_rng(seed)
    directions = random.normal(size=(3, 16))
    directions *= (np.pi / size) * random.uniform(0.4, 1.6, 16) / np.linalg.norm(directions, axis=0)
    phases = random.uniform(0, 2 * np.pi, 16).astype(np.float32)
    waves = points.astype(np.float32) @ directions.astype(np.float32) + phases
    return np.sin(waves).sum(axis=1) * np.float32(np.sqrt(2 / 16))
