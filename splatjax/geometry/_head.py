"""A head, modeled in clay: serene, eyes closed. Its signed distance, mm; +y up, facing +z, eyes
near y = 0.
"""

import numpy as np
from jaxtyping import Float

from ._sdf import bump, carve, ellipsoid, join, keep, limb, smooth_step

LOW, HIGH = (-140.0, -226.0, -125.0), (140.0, 124.0, 125.0)


def head_distance(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Give the signed distance to the bust, to first order; single precision, as the points are."""
    x, y, z = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    side = np.abs(x)
    body = _masses(x, y, z, side)
    near = np.flatnonzero((z > 25) & (y > -125) & (y < 60) & (side < 75))
    if len(near):
        body[near] = _face(body[near], x[near], y[near], z[near], side[near])
    near = np.flatnonzero((side > 48) & (y > -65) & (y < 45) & (z > -65) & (z < 45))
    if len(near):
        body[near] = _ear(body[near], y[near], z[near], side[near])
    return body


def _masses(x, y, z, side):
    """Skull, face, jaw, neck and shoulders."""
    p, q = (x, y, z), (side, y, z)
    skull = ellipsoid(p, (0, 40, -14), (75, 73, 90))
    skull = join(skull, ellipsoid(p, (0, 36, -40), (75, 62, 64)), 20)
    skull = join(skull, ellipsoid(p, (0, 44, 20), (62, 58, 62)), 24)
    face = ellipsoid(p, (0, -30, 16), (57, 78, 62))
    jaw = limb(q, (42, -58, -4), (13, -95, 61), 14, 14)
    jaw = join(jaw, ellipsoid(p, (0, -97, 66), (19, 15, 17)), 14)
    face = join(face, jaw, 28)
    face = join(face, ellipsoid(q, (40, -42, 22), (21, 36, 34)), 22)
    head_side = ellipsoid(q, (47, 4, 26), (15, 24, 26))
    skull = join(skull, head_side, 16)
    cheek = limb(q, (43, -19, 55), (63, -12, 6), 12, 8)
    head = join(join(skull, face, 24), cheek, 24)
    neck = limb(p, (0, -40, -36), (0, -205, -44), 49, 54)
    neck = join(neck, ellipsoid(p, (0, -28, -55), (50, 42, 36)), 26)
    blunt = (np.sqrt(x * x + 144), y, z)  # no crease down the middle
    cord = limb(blunt, (52, -42, -30), (20, -190, 2), 9, 9)
    neck = join(neck, cord, 26)
    neck = join(neck, ellipsoid(p, (0, -132, 3), (12, 17, 9)), 16)
    slope = limb(blunt, (22, -140, -50), (118, -208, -48), 30, 30)
    chest = ellipsoid(p, (0, -232, -28), (128, 62, 60))
    torso = join(join(neck, slope, 44), chest, 40)
    torso = keep(torso, ellipsoid(p, (0, -150, -34), (122, 110, 94)), 14)
    torso = keep(torso, -(y + 214), 10)
    return join(head, torso, 30)


def _face(body, x, y, z, side):
    p, q = (x, y, z), (side, y, z)
    # brow and sockets
    brow = join(
        limb(q, (8, 21, 78.5), (36, 27, 71), 7, 7), limb(q, (36, 27, 71), (52, 13, 48), 7, 6), 10
    )
    brow = join(brow, limb(p, (-10, 21, 78), (10, 21, 78), 7, 7), 8)
    rim = limb(q, (51, 12, 47), (48, -14, 54), 6, 8)
    body = join(join(body, brow, 16), rim, 20)
    body = carve(body, ellipsoid(q, (30, 3, 88), (19, 13, 17)), 14)
    # muzzle, chin, hollows of the cheeks
    body = join(body, ellipsoid(p, (0, -60, 56), (31, 27, 31)), 22)
    return _lips(_eyes(_nose(body, p, q), x, y, z, side), x, y, z, side)


def _nose(body, p, q):
    ridge = limb(p, (0, 12, 77), (0, -34, 100), 6.5, 7)
    flank = limb(p, (0, 4, 70), (0, -38, 86), 9, 14.5)
    nose = join(join(ridge, flank, 10), ellipsoid(p, (0, -37, 101), (9.5, 8.8, 9.5)), 8)
    nose = join(nose, ellipsoid(q, (13, -41.5, 91), (6, 7.2, 9.5)), 5)
    nose = join(nose, limb(p, (0, -46, 84), (0, -43.5, 101), 4.6, 4.2), 4)
    body = join(body, nose, 9)
    return carve(body, limb(q, (8.2, -50.5, 94.5), (7.0, -41, 93), 2.6, 1.6), 2)


def _eyes(body, x, y, z, side):
    q = (side, y, z)
    across = side - 31
    parting = -6.5 + 0.012 * across**2 - 0.02 * across
    open_span = smooth_step(np.abs(across), 17, 12)
    lids = ellipsoid(q, (31, -1, 61.5), (17, 14, 15))
    upper = smooth_step(y - parting, -0.6, 0.6)
    lids = lids - 1.3 * open_span * upper * bump(y - parting, 0.0, 7.0)
    lids = lids + 0.9 * open_span * bump(y, parting - 0.5, 0.8)
    body = join(body, lids, 6)
    fold = 7.2 - 0.018 * across**2
    front = smooth_step(z, 58, 68)
    return body + front * 1.3 * bump(y, fold, 1.9) * smooth_step(np.abs(across), 18, 11)


def _lips(body, x, y, z, side):
    q = (side, y, z)
    bow = limb(q, (4.5, -62.8, 84.5), (24.5, -67.2, 74), 4.6, 2.0)
    upper = join(bow, ellipsoid((x, y, z), (0, -65.2, 85.5), (6, 4, 4.6)), 3)
    lower = limb(q, (6, -72.2, 82.4), (23, -68.3, 75), 5, 2.2)
    lower = join(lower, ellipsoid((x, y, z), (0, -72.6, 82.6), (13, 5.3, 6)), 5)
    parting = -67.9 + 0.9 * bump(side, 7, 5) - 0.9 * bump(side, 0, 5)
    body = join(body, upper, 3.2)
    body = join(body, lower, 3.2)
    reach = smooth_step(side, 29, 23) * smooth_step(z, 60, 72)
    body = body + reach * 2.2 * bump(y, parting, 1.3)
    front = smooth_step(z, 55, 70)
    body = body + front * 1.4 * bump(x, 0, 3.6) * bump(y, -54.5, 6)
    body = body - front * 0.8 * bump(side, 5, 2.6) * bump(y, -55.5, 6)
    return body + front * 2.6 * bump(x, 0, 17) * bump(y, -81, 5.5)


def _ear(body, y, z, side):
    """A pinna that stands off the head, thin enough for light to come through."""
    turn, lean = np.radians(24), np.radians(12)
    a, b, c = side - 69, y + 9, z + 8
    back = a * np.sin(turn) - c * np.cos(turn)
    out = a * np.cos(turn) + c * np.sin(turn)
    s = back * np.cos(lean) - b * np.sin(lean) - 9
    t = back * np.sin(lean) + b * np.cos(lean)
    half_width = 17.5 + 0.13 * t
    k = np.sqrt((s / half_width) ** 2 + (t / 32) ** 2)
    inward = (1 - k) * 18  # mm from the outline, about
    sheet = out - 5 + 3.0 * smooth_step(inward, 2, 13)
    pinna = keep(np.abs(sheet) - 1.5, -inward, 2)
    spared = smooth_step(t, -22, -10)
    helix = np.sqrt((inward - 2.2) ** 2 + (sheet - 1.9) ** 2) - 2.7 * (0.55 + 0.45 * spared)
    pinna = join(pinna, helix, 2)
    ridge = np.sqrt((s / (half_width * 0.56) - 0.05) ** 2 + ((t + 1) / 19) ** 2)
    anti = np.sqrt(((1 - ridge) * 10) ** 2 + (sheet - 1.6) ** 2) - 2.1
    anti = anti + 6 * smooth_step(s, -1, -5)
    pinna = join(pinna, anti, 3)
    concha = ellipsoid((s, t, out), (-3.5, -4, 7), (8.5, 12.5, 7.5))
    lobe = ellipsoid((s, t, out), (-2, -27, 4.5), (8.5, 7.5, 2.6))
    pinna = join(pinna, lobe, 4)
    root = ellipsoid((s, t, out), (-7, -3, -5), (12, 20, 8))
    body = join(join(body, root, 10), pinna, 4)
    body = carve(body, concha, 3)
    tragus = ellipsoid((s, t, out), (-11.5, -7, 4.5), (4, 5.5, 3))
    return join(body, tragus, 3)
