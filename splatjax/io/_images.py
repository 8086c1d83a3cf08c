"""Reading of pictures in all formats of OpenImageIO, with row 0 at the top; writing of PNG for
displays, and of frames with all layers as OpenEXR.
"""

import errno
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR  # ty: ignore[import-not-found]
from jaxtyping import Array, Float

from splatjax._display import png_of, srgb_to_linear, to_display
from splatjax._memory import check_memory
from splatjax._records import Numbers
from splatjax.scene import Camera, Frame

from ._cameras import camera_matrices
from ._files import StrPath, atomic_path, check_suffix, existing_file, expect, naming
from ._spectra import SPECTRAL, channel_names, picture_to_rgb

MANIFEST = "splatjax.manifest"  # header attribute with the settings of a picture
_REC709_D65 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_CHROMATICITY = 1e-3  # tolerance
_BYTES_PER_VALUE = 24.0  # while decoding in double precision


def read_planes(
    path: StrPath,
) -> tuple[dict[str, Float[np.ndarray, "height width"]], dict[str, Any], bool]:
    """Read the channels of a picture by name. Integers are divided by the maximum of their type.
    Values are not decoded, and colors are not multiplied by alpha.

    **Returns:** the channels, the attributes of the file, and whether its values are floats.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read, is truncated, does
    not store exactly the whole picture, or does not fit into memory.
    """
    import OpenImageIO as oiio  # 17 MB, so imported only here

    path = existing_file(path)
    settings, pixels, spec = oiio.ImageSpec(), None, oiio.ImageSpec()
    settings["oiio:UnassociatedAlpha"] = 1
    file = oiio.ImageInput.open(str(path), settings)
    if file is not None:
        spec = file.spec()
        values = float(spec.width) * spec.height * spec.nchannels
        expect(
            spec.roi == spec.roi_full,
            path,
            f"stores {spec.width} x {spec.height} pixels at ({spec.x}, {spec.y}) of a picture of "
            f"{spec.full_width} x {spec.full_height} at ({spec.full_x}, {spec.full_y}); save all "
            "of it, and no more",
        )
        size = f"{path}: a picture of {spec.width} x {spec.height} x {spec.nchannels} numbers"
        check_memory(size, _BYTES_PER_VALUE * values, "give a smaller one")
        pixels = file.read_image("float")
    try:
        fault = oiio.geterror() if file is None else file.geterror()
    except UnicodeDecodeError:  # the message contains bytes of the file
        fault = "its header is damaged"
    if pixels is None or fault:
        fault = " ".join(fault.replace(f'"{path}"', "").split())
        raise ValueError(
            f"{path}: cannot be read as a picture ({fault}); give a complete JPEG, PNG, TIFF "
            "or OpenEXR file"
        )
    planes = dict(zip(spec.channelnames, np.moveaxis(pixels, -1, 0), strict=True))
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    return planes, attributes, str(spec.format) in ("half", "float", "double")


def read_picture(path: StrPath) -> Float[np.ndarray, "height width channels"]:
    r"""Read a picture in linear light, from OpenEXR or another floating-point format.

    **Returns:** R, G and B, or Y alone, as in the file.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read, has neither R, G
    and B nor Y, has other primaries than Rec. 709 and D65, or contains integers, which are encoded
    for a display.
    """
    values, is_linear = _colors(path)
    expect(is_linear, path, "is encoded for a display; give linear light, such as OpenEXR")
    return values


def read_map(path: StrPath) -> Float[np.ndarray, "height width 3"]:
    """Read a map of data other than color, with three channels and without decoding."""
    values, _ = _colors(path)
    return np.broadcast_to(values, (*values.shape[:2], 3))


def read_color(path: StrPath) -> Float[np.ndarray, "height width 3"]:
    """Read an albedo in linear light. Integers are sRGB; floating-point numbers are linear.

    **Raises:** as `read_picture` does, and `ValueError` for values outside [0, 1].
    """
    values, is_linear = _colors(path)
    expect(
        ((values >= 0) & (values <= 1)).all(),
        path,
        "has an albedo outside [0, 1]; scale it, and remove NaN",
    )
    return np.broadcast_to(values if is_linear else srgb_to_linear(values), (*values.shape[:2], 3))


def _colors(path: StrPath) -> tuple[Float[np.ndarray, "height width _"], bool]:
    planes, attributes, is_linear = read_planes(path)
    names = "RGB" if "R" in planes else "Y"
    expect(planes.keys() >= {*names}, path, f"has neither R, G and B nor Y: {', '.join(planes)}")
    primaries = np.asarray(attributes.get("chromaticities", _REC709_D65))
    expect(
        names == "Y" or np.allclose(primaries, _REC709_D65, atol=_CHROMATICITY),
        path,
        f"has other primaries than Rec. 709 and D65: {np.round(primaries, 4).tolist()}; convert "
        "it, or remove `chromaticities` from data",
    )
    with np.errstate(invalid="ignore"):  # from signaling NaN
        return np.stack([planes[name] for name in names], axis=-1).astype(np.float64), is_linear


def write_png(
    path: StrPath,
    picture: Frame | Float[Array, "height width _"] | Float[np.ndarray, "height width _"],
    *,
    exposure: float = 0.0,
    wavelengths: Numbers | None = None,
    illuminant: str | None = "D65",
) -> None:
    r"""Write a picture for an sRGB display with 8 bits, atomically.

    **Arguments:**

    - `picture`: a frame, whose beauty is written over black, or linear floating-point values of 1
      (gray), 3 (RGB) or 4 channels (premultiplied RGB and alpha, written unpremultiplied as PNG
      requires).
    - `exposure`: exposure in stops: values are multiplied by `2^exposure`, clipped at 1 and
      encoded.
    - `wavelengths`: wavelengths of the channels, nm, such as `material.wavelengths`; the spectra
      are converted to color under an `illuminant`, as `picture_to_rgb` does.

    **Raises:** `ValueError` for another suffix, number of axes or channels, for integers, and for
    an exposure that is not finite; `FileNotFoundError` if the folder does not exist.
    """
    check_suffix(path, ".png")
    values = picture.beauty if isinstance(picture, Frame) else picture
    with naming(path):
        if isinstance(picture, Frame) and values.shape[-1] == 4 and wavelengths is None:
            raise ValueError("a frame of 4 channels has no alpha; give their wavelengths")
        rgb = picture_to_rgb(np.asarray(values), wavelengths, illuminant)
        content = png_of(to_display(rgb, exposure))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


_WEIGHTS, _VARIANCES = "splatjax.weights.", "splatjax.variances"
_SINGLE = "single_scattering"
_LARGEST_HALF = 65504.0


def write_exr(
    path: StrPath,
    frame: Frame,
    *,
    variances: Sequence[float] | None = None,
    manifest: Mapping[str, Any] | None = None,
    camera: Camera | None = None,
    half: bool = False,
    wavelengths: Numbers | None = None,
) -> None:
    r"""Write a frame and all its layers to an OpenEXR file in single precision, atomically.

    | channels | contents |
    | --- | --- |
    | `R G B A` | beauty, premultiplied, and coverage |
    | `Z` | depth, mm; inf where no surface is visible |
    | `position.X Y Z`, `normal.X Y Z` | of the front surface, in world space; positions in mm |
    | `albedo.R G B`, `irradiance.R G B`, `diffuse.R G B`, `specular.R G B` | premultiplied |
    | `single_scattering.R G B` | premultiplied; only if the material has this term |
    | `shadow1.Y`, `shadow2.Y`, ... | per light |
    | `diffusion1.R G B`, ... | per Gaussian: `diffuse = sum_k weights_k diffusion_k` |

    If there are not 3 channels, R G B become `beauty.1`, `beauty.2`, ..., `albedo.1`, ...; with
    `wavelengths`, they become `S0.550,000nm`, ..., `albedo.S0.550,000nm`, ..., the layout of
    Fichet, Pacanowski and Wilkie 2021 for spectral images. The header contains the weights of the
    Gaussians (`splatjax.weights.1`, ..., one value per channel) and the color space (linear, Rec.
    709 primaries, D65).

    **Arguments:**

    - `variances`: variances of the Gaussians, mm^2, written to the header.
    - `manifest`: settings of the picture, written to the header as JSON (`read_manifest`).
    - `camera`: the camera of the picture, written as `worldToCamera` (right, up and forward, mm)
      and `worldToNDC` (column and row divided by the size of the picture), as in RenderMan. Both
      multiply row vectors: `[x y z 1] M`, divided by the last entry.
    - `half`: write half precision, except for depth and position.
    - `wavelengths`: wavelengths of the channels, nm.

    **Raises:** `ValueError` for a suffix other than `.exr`; `FileNotFoundError` if the folder does
    not exist.
    """
    check_suffix(path, ".exr")
    from splatjax import __version__  # defined after the package is imported

    weights = np.asarray(frame.weights, np.float32)
    gaussians, channels = weights.shape
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"splatjax {__version__}",
        "comments": "Linear light; mm. Depth, position and normal are not premultiplied.",
        "splatjax.unresolved_fraction": np.asarray(frame.unresolved_fraction, np.float32).tolist(),
        "splatjax.overflow": float(frame.overflow),
        **{f"{_WEIGHTS}{k}": row.tolist() for k, row in enumerate(weights, 1)},
    }
    if wavelengths is not None:
        header |= {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}
    elif channels == 3:
        header |= {"chromaticities": _REC709_D65, "colorInteropID": "lin_rec709_scene"}
    if variances is not None:
        header[_VARIANCES] = np.asarray(variances, np.float32).tolist()
    if manifest is not None:
        header[MANIFEST] = json.dumps(manifest)
    if camera is not None:
        header |= camera_matrices(camera)
    planes: dict[str, np.ndarray] = {}
    names = channel_names(channels, wavelengths)
    has_single = frame.single_scattering is not None
    for field, layer in _layout(names, len(frame.shadow), gaussians, has_single).items():
        values = np.asarray(getattr(frame, field), np.float32)
        if field != "shadow" and layer.ndim:
            values = np.moveaxis(values, -1, layer.ndim - 1)
        values = np.ascontiguousarray(values.reshape(-1, *frame.coverage.shape))
        if half and field not in ("depth", "position"):
            values = np.clip(values, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)
        planes |= dict(zip(layer.ravel(), values, strict=True))
    with atomic_path(path) as temporary, OpenEXR.File(header, planes) as file:
        try:
            file.write(str(temporary))
        except Exception as error:  # OpenEXR raises exceptions of any kind
            reason = " ".join(str(error).replace(str(temporary), "").split())
            raise OSError(errno.EIO, reason, str(temporary)) from None


def read_exr(path: StrPath) -> Frame:
    r"""Read a frame that `write_exr` wrote. Single precision is restored exactly.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read or lacks layers of a
    frame.
    """
    planes, header, _ = read_planes(path)
    names = sorted(name for name in planes if name.startswith(SPECTRAL)) or channel_names(
        3 if "R" in planes else sum(name.startswith("beauty.") for name in planes)
    )
    gaussians = sum(name.startswith(_WEIGHTS) for name in header)
    lights = sum(name.startswith("shadow") for name in planes)
    has_single = any(name.startswith(_SINGLE) for name in planes)
    try:
        weights = [header[f"{_WEIGHTS}{k}"] for k in range(1, gaussians + 1)]
        arrays = {
            "weights": np.reshape(weights, (gaussians, len(names))),
            "unresolved_fraction": np.reshape(header["splatjax.unresolved_fraction"], gaussians),
            "overflow": np.reshape(header["splatjax.overflow"], ()),
        }
        for field, layer in _layout(names, lights, gaussians, has_single).items():
            values = np.asarray([planes[name] for name in layer.ravel()])
            values = values.reshape(*layer.shape, *planes["A"].shape)
            arrays[field] = values if field == "shadow" else np.moveaxis(values, layer.ndim - 1, -1)
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"{path}: lacks {' '.join(str(error).split())}, so it is not a frame; give a file "
            "written by write_exr"
        ) from None
    return Frame(**{name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()})


def _layout(names: list[str], lights: int, gaussians: int, has_single: bool) -> dict[str, Any]:
    """Name the planes of each field of a frame, in arrays over all axes of the field except height
    and width.
    """

    def colors(layer: str) -> list[str]:
        return [f"{layer}.{name}" for name in names]

    color = ["albedo", "irradiance", "diffuse", "specular", *([_SINGLE] if has_single else [])]
    layout: dict[str, Any] = {
        "beauty": colors("beauty") if "1" in names else names,
        "coverage": "A",
        "depth": "Z",
        **{layer: [f"{layer}.{axis}" for axis in "XYZ"] for layer in ("position", "normal")},
        **{layer: colors(layer) for layer in color},
        "shadow": [f"shadow{k}.Y" for k in range(1, lights + 1)],
        "layers": np.reshape(
            [colors(f"diffusion{k}") for k in range(1, gaussians + 1)], (gaussians, len(names))
        ),
    }
    return {field: np.asarray(names) for field, names in layout.items()}
