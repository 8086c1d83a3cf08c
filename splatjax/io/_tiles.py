"""Textures that end at their borders, or are mirrored there, made into such as repeat."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._pictures import BYTES_PER_PIXEL
from ._pieces import Piece, Wrap
from ._room import check_room

_FARTHEST = 2.0  # that coordinates may reach beyond a border, in tiles


def tiled(path: Path, piece: Piece, *, upside_down: bool) -> Piece:
    """Give a piece whose texture repeats and shows the same: it is widened by what lies beyond its
    borders.

    **Arguments:**

    - `upside_down`: whether v = 0 will be the other edge of the texture.

    **Raises:** `ValueError` for coordinates that reach far beyond a texture that ends.
    """
    if (
        piece.texture is None
        or piece.uvs is None
        or piece.wraps == ("wrap", "wrap")
        or not np.isfinite(piece.uvs).all()
    ):
        return piece
    picture, uvs = piece.texture(), piece.uvs.copy()
    if upside_down:
        uvs[..., 1] = 1 - uvs[..., 1]
    for coordinate, (axis, wrap) in enumerate(zip((1, 0), piece.wraps, strict=True)):
        picture, uvs[..., coordinate] = _widened(path, picture, uvs[..., coordinate], axis, wrap)
    if upside_down:
        uvs[..., 1] = 1 - uvs[..., 1]
    return piece._replace(uvs=uvs, texture=lambda: picture, wraps=("wrap", "wrap"))


def _widened(
    path: Path,
    picture: Float[np.ndarray, "height width 3"],
    along: Float[np.ndarray, "faces 3"],
    axis: int,
    wrap: Wrap,
) -> tuple[np.ndarray, np.ndarray]:
    """Widen a picture along an axis, and give the coordinates that it then has."""
    size = picture.shape[axis]
    if wrap == "wrap":
        return picture, along
    beyond = max(-float(along.min()), float(along.max()) - 1, 0.0)
    if wrap == "symmetric":  # the picture and its mirror image repeat
        before, after = (size, 0) if axis == 0 else (0, size)  # rows begin at the top, where v is 1
        start = 0
    else:
        if beyond > _FARTHEST:
            raise ValueError(
                f"{path}: has texture coordinates {beyond:.3g} tiles beyond a texture that ends at "
                "its border;"
                " bring them to [0, 1]"
            )
        before = after = start = int(np.ceil(beyond * size)) + 1
    pixels = picture.shape[1 - axis] * (size + before + after)
    check_room(
        f"{path}: a texture of {pixels} pixels",
        BYTES_PER_PIXEL * pixels,
        "bring its coordinates to [0, 1]",
    )
    widths = [(0, 0)] * 3
    widths[axis] = (before, after)
    return np.pad(picture, widths, mode=wrap), (along * size + start) / (size + before + after)
