"""Materials as TOML files: optical coefficients, where they come from, and the Gaussians fitted to
them.
"""

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from splatjax.exports import plain_numbers
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import (
    BetterDipole,
    Dipole,
    ExactFresnel,
    Film,
    Layer,
    LayeredMultipole,
    Medium,
    PhotonBeam,
    SingleScattering,
)
from splatjax.scene import Material

from ._atomic import atomic_path
from ._tables import Table, as_array, nearest

COEFFICIENT_UNIT = "1/mm"
VARIANCE_UNIT = "mm^2"
THICKNESS_UNIT = "mm"
_COEFFICIENTS = {"unit", "sigma_a", "sigma_s_prime", "eta"}
_TABLES = ("medium", "layers", "surface", "single_scattering", "source", "fit")


def profiles_folder() -> Path:
    """Give the folder of the materials that come with the package: inside the wheel, or at the top
    of a checkout.
    """
    package = Path(__file__).resolve().parents[1]
    in_wheel = package / "_profiles"
    return in_wheel if in_wheel.is_dir() else package.parent / "profiles"


def materials() -> tuple[str, ...]:
    """Give the names of the materials that come with the package, in alphabetical order."""
    return tuple(sorted(path.stem for path in profiles_folder().glob("*.toml")))


def material_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Give the file behind what `load_material` takes: that of a name, or the path itself.

    **Raises:** `ValueError` for an unknown name.
    """
    path = Path(name_or_path)
    if not isinstance(name_or_path, str) or path.suffix or len(path.parts) != 1:
        return path
    known = materials()
    if name_or_path in known:
        return profiles_folder() / f"{name_or_path}.toml"
    hint = nearest(name_or_path, known)
    raise ValueError(
        f"{name_or_path}: is no known material; {hint} (a file is named by its path: "
        f"./{name_or_path}.toml)"
    )


def load_material(name_or_path: str | os.PathLike[str]) -> Material:
    r"""Load a material: its fitted Gaussians and its surface.

    **Arguments:**

    - `name_or_path`: one of `materials()`, or the path of a TOML file.

    **Returns:** a `Material` in JAX's default precision; variances in mm^2, ascending.

    **Raises:** `ValueError` for an unknown name, and for a file that is no material: what is wrong,
    and what would be right.
    """
    path, tables = _read(name_or_path)
    if "fit" not in tables:
        fitted = path.with_name(f"{path.stem}_fitted.toml")
        raise ValueError(
            f"{path}: has no [fit]; take what `splatjax fit {path} --output {fitted}` makes of its "
            "coefficients"
        )
    fit = Table(path, "fit", tables["fit"])
    fit.unit(VARIANCE_UNIT)
    variances = fit.numbers("variances", "positive (mm^2)", lambda x: x > 0)
    if np.any(np.diff(variances) <= 0):
        raise ValueError(
            f"{path}: [fit] variances must ascend, each once; got {variances.tolist()}"
        )
    weights = fit.matrix("weights", len(variances))
    single = None
    if "single_scattering" in tables:
        single = _single_scattering(
            Table(path, "single_scattering", tables["single_scattering"]), weights.shape[1]
        )
    surface = {"eta": 1.4, "specular": 0.18, "roughness": 0.3} | _surface(path, tables)
    return Material(
        SumOfGaussians(as_array(variances), as_array(weights)), **surface, single_scattering=single
    )


def surface_and_source(
    name_or_path: str | os.PathLike[str],
) -> tuple[dict[str, float], dict[str, Any]]:
    r"""Give what a file says of a material besides its coefficients: its surface, as `Material`
    takes it, and its [source].

    **Raises:** `ValueError` as `load_material` does.
    """
    path, tables = _read(name_or_path)
    source = tables.get("source", {})
    Table(path, "source", source)
    return _surface(path, tables), source


def load_medium(name_or_path: str | os.PathLike[str]) -> Medium:
    r"""Load the optical coefficients of a material.

    **Arguments:**

    - `name_or_path`: one of `materials()`, or the path of a TOML file.

    **Returns:** a `Medium` in JAX's default precision; coefficients in 1/mm.

    **Raises:** `ValueError` as `load_material` does, and for a material that was published without
    coefficients.
    """
    path, tables = _read(name_or_path)
    if "medium" not in tables:
        have = (
            "layers (`load_profile`)"
            if "layers" in tables
            else "Gaussians, ready for `splatjax render` or `load_material`"
        )
        raise ValueError(f"{path}: has no [medium]; known are only its {have}")
    return _medium(Table(path, "medium", tables["medium"]))


def load_profile(name_or_path: str | os.PathLike[str]) -> Dipole | LayeredMultipole:
    r"""Load the coefficients of a material as the profile that its Gaussians stand for.

    **Arguments:**

    - `name_or_path`: one of `materials()`, or the path of a TOML file.

    **Returns:** the `Dipole` of a [medium], or the `LayeredMultipole` of [[layers]], in JAX's
    default precision.

    **Raises:** `ValueError` as `load_material` does, and for a material that was published without
    coefficients.
    """
    path, tables = _read(name_or_path)
    if "layers" in tables:
        return _layered(path, tables["layers"])
    return Dipole(load_medium(path))


def save_material(
    material: Material,
    path: str | os.PathLike[str],
    *,
    profile: AbstractProfile | None = None,
    source: Mapping[str, Any] | None = None,
    fit: Mapping[str, Any] | None = None,
) -> None:
    r"""Write a material to a TOML file, whole or not at all.

    **Arguments:**

    - `material`: one material (no batch); written with the digits it needs to be read back as it
      was.
    - `path`: of the file; its folder must exist.
    - `profile`: what the Gaussians were fitted to; its coefficients are written, and in [fit] what
      it is.
    - `source`: where the numbers come from: `citation`, `provenance`, ...
    - `fit`: more to be kept in [fit]: `error`, `energy_error`, ...

    **Raises:** `OSError` if the file cannot be written, `ValueError` for another kind of profile.
    """
    if not isinstance(profile, Dipole | BetterDipole | PhotonBeam | LayeredMultipole | None):
        raise ValueError(
            f"profile must be a Dipole, BetterDipole, PhotonBeam or LayeredMultipole, which a file "
            f"can hold; got {type(profile).__name__}"
        )
    tables: dict[str, Any] = {}
    if isinstance(profile, LayeredMultipole):
        tables["layers"] = [_plain_layer(layer) for layer in profile.layers]
    elif profile is not None:
        tables["medium"] = _plain_medium(profile.medium)
    surface = {"eta": material.eta, "specular": material.specular, "roughness": material.roughness}
    tables["surface"] = {name: plain_numbers(value) for name, value in surface.items()}
    if material.single_scattering is not None:
        strength = plain_numbers(material.single_scattering.strength)
        tables["single_scattering"] = {
            **_plain_medium(material.single_scattering.medium),
            "strength": strength,
        }
    tables["source"] = dict(source or {})
    gaussians = material.gaussians
    tables["fit"] = {
        "unit": VARIANCE_UNIT,
        "variances": plain_numbers(gaussians.variances),
        "weights": plain_numbers(gaussians.weights),
        **({} if profile is None else {"profile": _description(profile)}),
        **{
            name: value if isinstance(value, str | int | float) else plain_numbers(value)
            for name, value in (fit or {}).items()
        },
    }
    with atomic_path(path) as temporary:
        temporary.write_text(_one_line_arrays(tomli_w.dumps(tables)), encoding="utf-8")


def _surface(path: Path, tables: dict[str, Any]) -> dict[str, float]:
    surface = Table(path, "surface", tables.get("surface", {}))
    surface.only({"eta", "specular", "roughness"})
    physical = {
        "eta": ("positive", lambda x: x > 0),
        "specular": ("at least 0", lambda x: x >= 0),
        "roughness": ("in (0, 1]", lambda x: 0 < x <= 1),
    }
    return {name: surface.number(name, *physical[name], 0.0) for name in surface.table}


def _description(profile: Dipole | BetterDipole | PhotonBeam | LayeredMultipole) -> str:
    moments = (
        "exact Fresnel moments"
        if isinstance(profile.fresnel, ExactFresnel)
        else "fitted Fresnel moments"
    )
    match profile:
        case Dipole():
            model = "classical dipole"
        case BetterDipole():
            model = "better dipole"
        case PhotonBeam():
            model = "photon beam with single scattering"
        case LayeredMultipole():
            model = f"multipole of {len(profile.layers)} layers"
    return f"{model}, {moments}"


def _plain_medium(medium: Medium) -> dict[str, Any]:
    coefficients = {
        "sigma_a": medium.sigma_a,
        "sigma_s_prime": medium.sigma_s_prime,
        "eta": medium.eta,
    }
    return {
        "unit": COEFFICIENT_UNIT,
        **{name: plain_numbers(values) for name, values in coefficients.items()},
    }


def _plain_layer(layer: Layer | Film) -> dict[str, Any]:
    if isinstance(layer, Film):
        return {"optical_depth": plain_numbers(layer.optical_depth)}
    return {
        "thickness": plain_numbers(layer.thickness),
        "thickness_unit": THICKNESS_UNIT,
        **_plain_medium(layer.medium),
    }


def _layered(path: Path, found: Any) -> LayeredMultipole:
    if not isinstance(found, list) or not found:
        raise ValueError(
            f"{path}: [[layers]] must be one table or more, from the top; it is {found!r}"
        )
    layers = [
        _layer(Table(path, f"layers {number}", table))
        for number, table in enumerate(found, start=1)
    ]
    counts = {
        layer.optical_depth.shape[0] if isinstance(layer, Film) else layer.medium.eta.shape[0]
        for layer in layers
    }
    if len(counts) != 1:
        raise ValueError(
            f"{path}: [[layers]] must all have one number per channel; they have {sorted(counts)} "
            "channels"
        )
    try:
        return LayeredMultipole(layers)
    except ValueError as error:
        raise ValueError(f"{path}: [[layers]]: {error}") from None


def _layer(table: Table) -> Layer | Film:
    table.only(_COEFFICIENTS | {"optical_depth", "thickness", "thickness_unit"})
    if "optical_depth" in table.table:
        return Film(as_array(table.numbers("optical_depth", "at least 0", lambda x: x >= 0)))
    table.unit(THICKNESS_UNIT, "thickness_unit")
    thickness = table.thickness("thickness")
    try:
        layer = Layer(_medium(table), as_array(thickness))
        layer.check_diffusion()
    except ValueError as error:
        if str(error).startswith(table.where):
            raise
        raise ValueError(f"{table.where} {error}") from None
    return layer


def _single_scattering(table: Table, channels: int) -> SingleScattering:
    table.only(_COEFFICIENTS | {"strength"})
    medium = _medium(table)
    strength = np.ones(len(medium.eta))
    if "strength" in table.table:
        strength = table.numbers("strength", "at least 0", lambda x: x >= 0, channels=len(strength))
    if not len(medium.eta) == len(strength) == channels:
        counts = f"{len(medium.eta)} and {len(strength)}"
        raise ValueError(
            f"{table.where} coefficients and strength must have {channels} channels, as [fit] has; "
            f"they have {counts}"
        )
    return SingleScattering(medium, as_array(strength))


def _medium(medium: Table) -> Medium:
    medium.unit(COEFFICIENT_UNIT)
    sigma_a = medium.numbers("sigma_a", "at least 0 (1/mm)", lambda x: x >= 0)
    sigma_s_prime = medium.numbers("sigma_s_prime", "positive (1/mm)", lambda x: x > 0)
    eta = medium.numbers("eta", "positive", lambda x: x > 0, channels=len(sigma_a))
    if not len(sigma_a) == len(sigma_s_prime) == len(eta):
        counts = f"{len(sigma_a)}, {len(sigma_s_prime)} and {len(eta)}"
        raise ValueError(
            f"{medium.where} sigma_a, sigma_s_prime and eta must have one number per channel; they "
            f"have {counts}"
        )
    return Medium(as_array(sigma_a), as_array(sigma_s_prime), as_array(eta))


def _read(name_or_path: str | os.PathLike[str]) -> tuple[Path, dict[str, Any]]:
    path = material_path(name_or_path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(
            f"{path}: cannot be read ({error.strerror}); check the path, or name a material "
            "(`materials()`)"
        ) from None
    except UnicodeDecodeError:
        raise ValueError(
            f"{path}: is no TOML file, and no text at all; a material is one"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: is no TOML file: {error}") from None
    unknown = sorted(set(tables) - set(_TABLES))
    if unknown:
        known = (
            "a material has [medium] or [[layers]], [surface], [single_scattering], "
            "[source] and [fit]"
        )
        raise ValueError(
            f"{path}: has an unknown entry {unknown[0]!r}; {nearest(unknown[0], _TABLES)} ({known})"
        )
    if not {"medium", "layers", "fit"} & set(tables):
        raise ValueError(
            f"{path}: has neither [medium] nor [[layers]] nor [fit]; a material needs one of them"
        )
    if {"medium", "layers"} <= set(tables):
        raise ValueError(
            f"{path}: has both [medium] and [[layers]]; a material is one or the other"
        )
    _surface(path, tables)
    if "medium" in tables:
        medium = Table(path, "medium", tables["medium"])
        if "sigma_s" in medium.table:
            raise ValueError(
                f"{medium.where} has sigma_s; give sigma_s_prime = (1 - g) sigma_s, with the mean "
                "cosine g"
            )
        medium.only(_COEFFICIENTS)
        _medium(medium)
    if "layers" in tables:
        _layered(path, tables["layers"])
    return path, tables


def _one_line_arrays(text: str) -> str:
    number = r"-?(?:[\d.]+(?:e[+-]?\d+)?|inf|nan)"
    return re.sub(
        rf"\[\s+((?:{number},\s+)+)\]",
        lambda m: "[" + ", ".join(m[1].replace(",", " ").split()) + "]",
        text,
    )
