"""Conversion of spectra to colors, and spectra of lamps, by the tables of colour-science."""

from typing import Any

import numpy as np
from jaxtyping import Float

from splatjax._records import Numbers, check_values

from ._tables import nearest

SPECTRAL = "S0."  # prefix of the names of spectral channels (the first Stokes component)
_COUNT, _STEPS = "the number of wavelengths", "the steps of wavelengths"
_GRID = np.arange(380.0, 781.0)  # nm


def spectrum_to_rgb(
    wavelengths: Numbers, illuminant: str | None = "D65"
) -> Float[np.ndarray, "wavelengths rgb"]:
    r"""Compute the matrix that converts a spectrum to linear sRGB, `spectrum @ matrix`, for the CIE
    1931 standard observer.

    The spectrum is linear between the wavelengths and constant beyond them. A surface that reflects
    all light has the color (1, 1, 1) under every illuminant; the lights of a scene determine the
    color of the light.

    **Arguments:**

    - `wavelengths`: nm, ascending.
    - `illuminant`: name in colour-science of an illuminant (`colour.SDS_ILLUMINANTS`: "D65", "A",
      "FL11", ...) or of a measured lamp (`colour.SDS_LIGHT_SOURCES`: "Philips TL-84", ...), if the
      spectrum is a reflectance. `None` if the spectrum is that of light; then daylight, D65, is
      white, and a spectrum of 1 has luminance 1.

    **Returns:** one row per wavelength. With an illuminant, each column sums to 1.

    **Raises:** `ValueError` for wavelengths that do not ascend or are not visible, and for an
    unknown name.
    """
    name = "E" if illuminant is None else illuminant  # equal energy
    hats, power, observer, to_rgb = _tables(wavelengths, name)
    rgb = hats @ (power[:, None] * observer) @ to_rgb.T
    return rgb / (observer[:, 1].sum() if illuminant is None else rgb.sum(axis=0))


def illuminant(name: str, wavelengths: Numbers) -> Float[np.ndarray, " wavelengths"]:
    r"""Compute the spectrum of a named light, for the lights of a scene:

        light = DirectionalLight((0, 0, -1), 3.14 * illuminant("A", material.wavelengths))

    Convert pictures under this light by `spectrum_to_rgb(wavelengths, None)`. Each entry is the
    mean over the band around its wavelength, weighted by the observer, so that narrow lines are not
    missed.

    **Arguments:** `name`: as in `spectrum_to_rgb`; `wavelengths`: nm, ascending.

    **Returns:** the power at each wavelength, with the luminance of a constant spectrum of 1.

    **Raises:** `ValueError` as `spectrum_to_rgb` does.
    """
    hats, power, observer, _ = _tables(wavelengths, name)
    shares = hats * observer.sum(axis=1)
    means = shares @ power / np.maximum(shares.sum(axis=1), 1e-30)
    return means * observer[:, 1].sum() / (means @ hats @ observer[:, 1])


def picture_to_rgb(picture: Any, wavelengths: Numbers | None, illuminant: str | None = "D65"):
    r"""Convert a picture whose channels are wavelengths to linear sRGB. Differentiable.

    **Arguments:** `picture`: one channel for each wavelength, along the last axis. `wavelengths`,
    `illuminant`: as in `spectrum_to_rgb`; without wavelengths, the picture is returned unchanged.

    **Raises:** `ValueError` as `spectrum_to_rgb` does, and if the numbers of channels and
    wavelengths differ.
    """
    if wavelengths is None:
        return picture
    matrix, channels = spectrum_to_rgb(wavelengths, illuminant), picture.shape[-1]
    check_values(_COUNT, len(matrix), f"{channels}, that of channels", lambda n: n == channels)
    return picture @ matrix.astype(picture.dtype)


def channel_names(channels: int, wavelengths: Numbers | None = None) -> list[str]:
    """Name the channels of a picture in an EXR file: R, G and B; numbers; or ascending wavelengths,
    in the form of Fichet, Pacanowski and Wilkie 2021.
    """
    if wavelengths is None:
        return list("RGB") if channels == 3 else [str(k) for k in range(1, channels + 1)]
    nodes = np.asarray(wavelengths)
    check_values(_STEPS, np.diff(nodes), "at least 0.001 (nm)", lambda x: x >= 1e-3)
    names = [SPECTRAL + f"{node:.3f}nm".replace(".", ",") for node in nodes]
    check_values(_COUNT, len(names), f"{channels}, that of channels", lambda n: n == channels)
    return names


def _tables(wavelengths: Numbers, name: str) -> tuple[np.ndarray, ...]:
    """Return tables on the grid: the weight of each wavelength in a spectrum that is linear between
    them, the spectrum of a light with luminance 1, and the observer (X, Y and Z); and the matrix
    from XYZ to linear sRGB.
    """
    nodes = np.asarray(wavelengths, np.float64)
    check_values(_STEPS, np.diff(nodes), "positive (nm)", lambda x: x > 0)
    if not nodes.size or nodes[0] > _GRID[-1] or nodes[-1] < _GRID[0]:
        raise ValueError(
            f"wavelengths {nodes.tolist()} must overlap the visible range, 380 to 780 nm"
        )
    import colour  # takes two seconds

    lights = {**colour.SDS_ILLUMINANTS, **colour.SDS_LIGHT_SOURCES}
    if name not in lights:
        raise ValueError(f"illuminant {name!r} is unknown; {nearest(name, lights)}")
    observer, light = (
        table.copy().align(colour.SpectralShape(*_GRID[[0, -1]], 1)).values
        for table in (colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"], lights[name])
    )
    hats = np.asarray([np.interp(_GRID, nodes, hat) for hat in np.eye(len(nodes))])
    power = light * observer[:, 1].sum() / (light @ observer[:, 1])
    return hats, power, observer, colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB
