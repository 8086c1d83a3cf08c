"""Conversion of spectra to color, by illuminant and observer."""

import numpy as np
from jaxtyping import Float

from splatjax._records import Numbers, check_values

from ._tables import nearest


def spectrum_to_rgb(
    wavelengths: Numbers,
    illuminant: str = "D65",
    observer: str = "CIE 1931 2 Degree Standard Observer",
) -> Float[np.ndarray, "wavelengths rgb"]:
    r"""Compute the matrix from a spectrum to linear sRGB: `spectrum @ matrix`.

    The spectrum is linear between the wavelengths and constant beyond them. A surface that reflects
    all light has the color (1, 1, 1) under every illuminant; the color of the light is a property
    of the lights of a scene.

    **Arguments:**

    - `wavelengths`: nm, ascending.
    - `illuminant`, `observer`: by their names in colour-science (`colour.SDS_ILLUMINANTS`,
      `colour.MSDS_CMFS`): "D65", "A", "FL11", ...

    **Returns:** one row for each wavelength; the sum of each column is 1.

    **Raises:** `ValueError` for wavelengths that do not ascend, and for an unknown name.
    """
    import colour  # takes two seconds

    known = np.asarray(wavelengths, np.float64)
    check_values("the steps of wavelengths", np.diff(known), "positive (nm)", lambda x: x > 0)
    tables = {"illuminant": colour.SDS_ILLUMINANTS, "observer": colour.MSDS_CMFS}
    for name, given in (("illuminant", illuminant), ("observer", observer)):
        if given not in tables[name]:
            raise ValueError(f"{name} {given!r} is unknown; {nearest(given, tables[name])}")
    shape = colour.SpectralShape(380, 780, 1)
    light = tables["illuminant"][illuminant].copy().align(shape).values
    seen = tables["observer"][observer].copy().align(shape).values
    hats = [np.interp(shape.wavelengths, known, hat) for hat in np.eye(len(known))]
    xyz = np.asarray(hats) @ (light[:, None] * seen)
    rgb = xyz @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T
    return rgb / rgb.sum(axis=0)
