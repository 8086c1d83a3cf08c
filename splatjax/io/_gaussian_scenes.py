"""Conversion of the ellipsoids of Gaussian-splatting scenes to discs."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from splatjax._display import srgb_to_linear
from splatjax._records import check_installed
from splatjax.geometry import estimate_normals

from ._files import expect

_PLACES, _COLORS = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_TURNS = ("rot_1", "rot_2", "rot_3", "rot_0")  # with the real part last
GAUSSIAN_COLUMNS = {*_PLACES, *_COLORS, *_SCALES, *_TURNS, "opacity"}
_HARMONIC = 0.5 / np.pi**0.5  # spherical harmonic of degree 0
_RADIUS = 2.0  # standard deviations; a disc of this radius has the variance of the Gaussian


def spz_columns(path: Path) -> dict[str, np.ndarray]:
    """Read the ellipsoids of an SPZ file with gsply, as columns like those of a PLY file.

    **Raises:** `ValueError` without gsply, and for a file that gsply cannot read.
    """
    check_installed(f"{path}: SPZ", "gsply")
    import gsply

    scene = gsply.read_spz(path)
    names = *_PLACES, *_COLORS, *_SCALES, *_TURNS[-1:], *_TURNS[:-1], "opacity"
    parts = scene.means, scene.sh0, scene.scales, scene.quats, scene.opacities
    return dict(zip(names, np.column_stack(parts).T, strict=True))


def surface_columns(
    path: Path, columns: Mapping[str, np.ndarray], opacity: float
) -> dict[str, np.ndarray]:
    """Convert the columns of ellipsoids to those of splats, in the unit of the file.

    Ellipsoids below an opacity are omitted. The normal is the shortest axis, the radius is that of
    a disc with the variance of the two other axes, and the albedo is the mean color, decoded from
    sRGB.
    """
    from scipy.spatial.transform import Rotation  # takes a third of a second

    with np.errstate(over="ignore"):
        is_kept = 1 / (1 + np.exp(-columns["opacity"].astype(float))) >= opacity
        centers, colors, scales, turns = (
            np.stack([columns[name][is_kept] for name in names], axis=1).astype(float)
            for names in (_PLACES, _COLORS, _SCALES, _TURNS)
        )
        scales = np.exp(scales)
    expect(
        is_kept.sum() >= 4,
        path,
        f"{is_kept.sum()} Gaussians have an opacity of {opacity:g}, and normals need at least 4; "
        "give a lower opacity",
    )
    axes = Rotation.from_quat(turns).as_matrix()
    normals = axes[np.arange(len(axes)), :, scales.argmin(axis=1)]
    is_inward = np.sum(normals * estimate_normals(centers), axis=1) < 0
    normals = np.where(is_inward[:, None], -normals, normals)
    warnings.warn(
        f"{path}: is a Gaussian-splatting scene, whose colors contain the light of its pictures; "
        f"{np.sum(~is_kept)} of {len(is_kept)} Gaussians are below an opacity of {opacity:g}, and "
        "are left out",
        stacklevel=3,
    )
    albedo = srgb_to_linear(np.clip(0.5 + _HARMONIC * colors, 0, 1))
    names = *_PLACES, "nx", "ny", "nz", "red", "green", "blue", "radius"
    radii = _RADIUS * np.sqrt(np.prod(np.sort(scales, axis=1)[:, 1:], axis=1))
    table = np.column_stack([centers, normals, albedo, radii])
    return dict(zip(names, table.T, strict=True))
