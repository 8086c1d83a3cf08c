"""Pictures of every format that OpenImageIO reads, as arrays with row 0 at the top; PNG and WebP
for displays.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from splatjax._display import linear_to_srgb as linear_to_srgb, png_of, to_display
from splatjax._memory import check_memory
from splatjax.scene import Frame

from ._files import StrPath, atomic_path, existing_file, naming

_BYTES_PER_VALUE = 24.0  # in double precision, while they are decoded


def read_planes(
    path: StrPath,
) -> tuple[dict[str, Float[np.ndarray, "height width"]], dict[str, Any], bool]:
    """Read the channels of a picture by name. Integers are divided by the maximum of their type.
    Nothing is decoded, and alpha is not multiplied.

    **Returns:** channels, attributes of the file, and whether its values are floats.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read, is cut short or
    does not fit into memory.
    """
    import OpenImageIO as oiio  # 17 MB, so only where a picture is read

    path = existing_file(path)
    settings, pixels, spec = oiio.ImageSpec(), None, oiio.ImageSpec()
    settings["oiio:UnassociatedAlpha"] = 1
    file = oiio.ImageInput.open(str(path), settings)
    if file is not None:
        spec = file.spec()
        values = float(spec.width) * spec.height * spec.nchannels
        size = f"{path}: a picture of {spec.width} x {spec.height} x {spec.nchannels} numbers"
        check_memory(size, _BYTES_PER_VALUE * values, "give a smaller one")
        pixels = file.read_image("float")
    try:
        fault = oiio.geterror() if file is None else file.geterror()
    except UnicodeDecodeError:  # it repeats bytes of the file
        fault = "its header is damaged"
    if pixels is None or fault:
        fault = " ".join(fault.replace(f'"{path}"', "").split())
        raise ValueError(
            f"{path}: cannot be read as a picture ({fault}); give a complete JPEG, PNG, TIFF "
            "or OpenEXR file"
        )
    planes = dict(zip(spec.channelnames, np.moveaxis(pixels, -1, 0), strict=True))
    attributes = {each.name: each.value for each in spec.extra_attribs}
    return planes, attributes, str(spec.format) in ("half", "float", "double")


def read_picture(path: StrPath) -> Float[np.ndarray, "height width channels"]:
    r"""Read a picture in linear light, of OpenEXR or another format of floating-point numbers.

    **Returns:** R, G and B, or Y alone, as in the file.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read, has neither R, G
    and B nor Y, or has integers, which are encoded for a display.
    """
    values, is_linear = _colors(path)
    if not is_linear:
        raise ValueError(f"{path}: is encoded for a display; give linear light, such as OpenEXR")
    return values


def read_map(path: StrPath) -> Float[np.ndarray, "height width 3"]:
    """Read a map of data other than color: three channels, not decoded."""
    values, _ = _colors(path)
    return np.broadcast_to(values, (*values.shape[:2], 3))


def read_color(path: StrPath) -> Float[np.ndarray, "height width 3"]:
    """Read an albedo in linear light: integers are sRGB, floating-point numbers are linear.

    **Raises:** as `read_picture` does, and `ValueError` for values outside [0, 1].
    """
    values, is_linear = _colors(path)
    if not ((values >= 0) & (values <= 1)).all():
        raise ValueError(f"{path}: has an albedo outside [0, 1]; scale it, and remove NaN")
    return np.broadcast_to(values if is_linear else srgb_to_linear(values), (*values.shape[:2], 3))


def _colors(path: StrPath) -> tuple[Float[np.ndarray, "height width _"], bool]:
    planes, _, is_linear = read_planes(path)
    names = "RGB" if "R" in planes else "Y"
    if not planes.keys() >= set(names):
        raise ValueError(f"{path}: has neither R, G and B nor Y; it has {', '.join(planes)}")
    with np.errstate(invalid="ignore"):  # of NaN that signals
        return np.stack([planes[name] for name in names], axis=-1).astype(np.float64), is_linear


def srgb_to_linear(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Decode sRGB values in [0, 1] to linear light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def write_png(
    path: StrPath,
    picture: Frame | Float[np.ndarray, "height width channels"],
    *,
    exposure: float = 0.0,
) -> None:
    r"""Write a picture for an sRGB display, 8 bits, completely or not at all.

    **Arguments:**

    - `picture`: a frame, whose beauty over black is written; or linear values of 1 (gray), 3 (RGB)
      or 4 channels (RGB premultiplied by alpha, and alpha; written without premultiplication, as
      PNG requires).
    - `exposure`: in stops: the values are multiplied by `2^exposure` before they are encoded.
      Values above 1 are clipped.

    **Raises:** `ValueError` for another number of channels or an exposure that is not finite,
    `FileNotFoundError` when the folder does not exist.
    """
    values = picture.beauty if isinstance(picture, Frame) else picture
    with naming(path):
        content = png_of(to_display(np.asarray(values), exposure))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_animation(
    path: StrPath, frames: Sequence[StrPath], *, frames_per_second: float = 24.0
) -> None:
    r"""Join pictures to one endlessly repeating animated WebP file, completely or not at all.

    It is lossless, and plays in every browser.

    **Arguments:**

    - `frames`: PNG files in order, at least one, all of one size.
    - `frames_per_second`: from 0.1 to 60; browsers slow down faster ones.

    **Raises:** `ValueError` for no frames, frames of several sizes, and a speed out of range;
    `OSError` when a frame cannot be read, or the folder does not exist.
    """
    if not frames or not 0.1 <= frames_per_second <= 60:
        raise ValueError(
            f"{path}: {len(frames)} frames at {frames_per_second:g} per second cannot be "
            "written; give at least one frame, and 0.1 to 60 per second"
        )
    # Whole milliseconds, but every frame begins when it should.
    begins = [round(1000 * i / frames_per_second) for i in range(len(frames) + 1)]
    options = {"save_all": True, "duration": np.diff(begins).tolist(), "loop": 0, "lossless": True}
    with atomic_path(path) as temporary:
        _Film(frames).save(temporary, format="WEBP", **options)


class _Film(Image.Image):
    """Files as one picture of many frames, so that one at a time is in memory."""

    def __init__(self, frames: Sequence[StrPath]):
        super().__init__()
        self._frames, self.n_frames = frames, len(frames)
        self.seek(0)

    def seek(self, frame: int) -> None:
        with Image.open(self._frames[frame]) as image:
            image.load()
            if self.size not in ((0, 0), image.size):
                raise ValueError(
                    f"{self._frames[frame]}: is {image.size} pixels, and the first is "
                    f"{self.size}; give all the same size"
                )
            self.im, self._mode, self._size = image.im, image.mode, image.size
