"""Materials in TOML files: optical coefficients, their source, and the Gaussians fitted to them."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from splatjax._library import profiles_folder as profiles_folder
from splatjax._records import check_ascending, check_values
from splatjax.exports import plain_numbers
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import (
    AngularLaw,
    BetterDipole,
    Burley,
    Dipole,
    ExactFresnel,
    LayeredMultipole,
    Medium,
    PhotonBeam,
    SingleScattering,
    Skin,
)
from splatjax.scene import Material

from ._files import StrPath, expect, naming, plain_record, record_names
from ._media import (
    BURLEY_ENTRIES,
    KINDS,
    LAYER_ENTRIES,
    MEDIUM_ENTRIES,
    OPENPBR_ENTRIES,
    burley_of,
    digest_of,
    layer_of,
    medium_of,
    plain_burley,
    plain_layer,
    plain_medium,
    plain_openpbr,
)
from ._tables import Table, nearest, read_toml, write_toml

VARIANCE_UNIT = "mm^2"
MATERIAL_TABLES = ("wavelengths", *KINDS, "surface", "single_scattering", "angles", "source", "fit")
_SURFACE = ("eta", "specular", "roughness")
_Stored: TypeAlias = Dipole | BetterDipole | PhotonBeam | LayeredMultipole | Skin | Burley
# Descriptions in [fit] of the profiles whose coefficients a file can store.
_MODELS: dict[type, str] = {
    Dipole: "classical dipole",
    BetterDipole: "better dipole",
    PhotonBeam: "photon beam with single scattering",
    LayeredMultipole: "multipole",
    Skin: "photon beams of dermis and epidermis with the total of light transport",
    Burley: "normalized diffusion",
}


def list_materials() -> tuple[str, ...]:
    """Return the names of the materials that come with the package, in alphabetical order."""
    return tuple(sorted(path.stem for path in profiles_folder().glob("*.toml")))


def material_path(name_or_path: StrPath) -> Path:
    """Return the path of a material given by name or path, as in `load_material`.

    **Raises:** `ValueError` for an unknown name.
    """
    path = Path(name_or_path)
    if not isinstance(name_or_path, str) or path.suffix or len(path.parts) != 1:
        return path
    expect(
        name_or_path in list_materials(),
        name_or_path,
        f"is not a known material; {nearest(name_or_path, list_materials())} (a file is named by "
        f"its path: ./{name_or_path}.toml)",
    )
    return profiles_folder() / f"{name_or_path}.toml"


def load_material(name_or_path: StrPath | Table) -> Material:
    r"""Load the fitted Gaussians and the surface of a material.

        load_material("skin").white()  # for splats whose albedo gives the color

    **Arguments:** `name_or_path`: one of `list_materials()`, a TOML file, or a `Table` of one.

    **Returns:** a `Material` in JAX's default precision; variances in mm^2, ascending.

    A warning reports coefficients that were changed after their fit.

    **Raises:** `ValueError` for an unknown name, and, with the fault and the remedy, for a file
    that is not a material.
    """
    tables, surface, profile = _read(name_or_path)
    path, fitted = tables.path, tables.path.with_name(f"{tables.path.stem}_fitted.toml")
    remedy = f"fit its coefficients by `splatjax fit {path} --output {fitted}`"
    expect("fit" in tables.entries, path, f"has no [fit]; {remedy}")
    fit = tables.table("fit", tables.entries["fit"])
    fit.one_of("unit", [VARIANCE_UNIT])
    digest = digest_of(tables.entries)
    if fit.entries.get("coefficients_digest", digest) != digest:
        if tables.name:  # a table of a scene file
            remedy = "copy it to a file, `splatjax fit` that, and name the result as `material`"
        warnings.warn(
            f"{tables.where.rstrip(':')} has coefficients that were changed after the fit, and the "
            f"Gaussians that are rendered still belong to the earlier ones; {remedy}",
            stacklevel=1,  # so that a command that loads a file several times warns once
        )
    gaussians = fit.record(SumOfGaussians)
    fit.make(check_ascending, "variances", gaussians.variances)
    terms: dict[str, Any] = dict(surface)
    if isinstance(profile, Dipole):
        terms["medium"] = profile.medium
    if "single_scattering" in tables.entries:
        table = tables.table("single_scattering", (*MEDIUM_ENTRIES, "strength"))
        terms["single_scattering"] = table.record(SingleScattering, medium=medium_of(table))
    if "angles" in tables.entries:
        terms["angles"] = tables.table("angles", record_names(AngularLaw)).record(AngularLaw)
    return fit.make(Material, gaussians, **terms)


def surface_and_source(name_or_path: StrPath) -> tuple[dict[str, Any], dict[str, Any]]:
    r"""Return the arguments of `Material` for surface and wavelengths in a file, and its [source].

    **Raises:** `ValueError` as `load_material` does.
    """
    tables, surface, _ = _read(name_or_path)
    return surface, tables.entries.get("source", {})


def load_medium(name_or_path: StrPath) -> Medium:
    r"""Load the optical coefficients of a material.

    **Arguments:** `name_or_path`: one of `list_materials()`, or the path of a TOML file.

    **Returns:** a `Medium` in JAX's default precision; coefficients in 1/mm.

    **Raises:** `ValueError` as `load_material` does, and for a material without coefficients.
    """
    tables, _, profile = _read(name_or_path)
    if isinstance(profile, Dipole):
        return profile.medium
    contents = (
        "layers, pigments or profile (`load_profile`)" if profile else "Gaussians (`load_material`)"
    )
    raise ValueError(
        f"{tables.path}: has no [medium], only its {contents}; give a material with coefficients"
    )


def load_mean_cosine(material: StrPath | Table) -> float:
    r"""Load `g`, the mean cosine of a material's phase function, which is 0 if not given.

    **Raises:** `ValueError` as `load_material` does.
    """
    tables, _, profile = _read(material)
    if not isinstance(profile, Dipole):
        return 0.0
    return tables.table("medium", MEDIUM_ENTRIES).number("g", 0.0)


def load_profile(name_or_path: StrPath) -> Dipole | LayeredMultipole | Skin | Burley:
    r"""Load the coefficients or the pigments of a material, to fit Gaussians to their profile.

    **Arguments:** `name_or_path`: one of `list_materials()`, or the path of a TOML file.

    **Returns:** the `Dipole` of a [medium] or [openpbr], the `LayeredMultipole` of [[layers]], the
    `Skin` of a [skin], or the `Burley` of a [burley], in JAX's default precision.

    **Raises:** `ValueError` as `load_medium` does.
    """
    return _read(name_or_path)[2] or Dipole(load_medium(name_or_path))


def load_skin(material: StrPath | Table) -> Skin | None:
    """Load the pigments of a material from its file or tables; `None` without [skin].

    **Raises:** `ValueError` as `load_medium` does.
    """
    profile = _read(material)[2]
    return profile if isinstance(profile, Skin) else None


def save_material(
    material: Material,
    path: StrPath,
    *,
    profile: AbstractProfile | Skin | None = None,
    source: Mapping[str, Any] | None = None,
    fit: Mapping[str, Any] | None = None,
    g: float = 0.0,
) -> None:
    r"""Write a material to a TOML file, atomically.

        save_material(material, "stone.toml", source={"provenance": "made up"})
        material = load_material("stone.toml")

    **Arguments:**

    - `material`: one material (no batch), written with enough digits to be restored exactly; its
      roughness is clamped to [0.05, 1], as in rendering.
    - `path`: path of the file; its folder must exist.
    - `profile`: the profile to which the Gaussians were fitted. Its coefficients are written
      instead of the material's `medium`, and its kind is written to [fit].
    - `source`: source of the numbers: `citation`, `provenance`, ...
    - `fit`: further entries of [fit]: `error`, `energy_error`, ...
    - `g`: mean cosine of the phase function, written to [medium].

    **Raises:** `OSError` if the file cannot be written; `ValueError` for another kind of profile,
    and for variances that do not ascend.
    """
    write_toml(path, plain_material(material, profile, source, fit, g))


def plain_material(
    material: Material,
    profile: AbstractProfile | Skin | None = None,
    source: Mapping[str, Any] | None = None,
    fit: Mapping[str, Any] | None = None,
    g: float = 0.0,
) -> dict[str, Any]:
    """Return the tables of a material file. The arguments are those of `save_material`."""
    if not isinstance(profile, _Stored | None):
        raise ValueError(
            "profile must be a Dipole, BetterDipole, PhotonBeam, LayeredMultipole, Skin or Burley, "
            f"which a file can store; got {type(profile).__name__}"
        )
    check_ascending("variances", material.gaussians.variances)
    surface = {name: getattr(material, name) for name in _SURFACE}
    surface["roughness"] = jnp.clip(material.roughness, 0.05, 1.0)  # as rendered
    tables: dict[str, Any] = {}
    if isinstance(profile, Skin):
        tables["skin"] = plain_record(profile)
    elif isinstance(profile, Burley):
        tables["burley"] = plain_burley(profile)
    elif isinstance(profile, LayeredMultipole):
        tables["layers"] = [plain_layer(layer) for layer in profile.layers]
    elif (medium := material.medium if profile is None else profile.medium) is not None:
        tables["medium"] = plain_medium(medium) | ({"g": g} if g else {})
    if (single := material.single_scattering) is not None:
        own = plain_record(single, medium=None)
        tables["single_scattering"] = plain_medium(single.medium) | own
    if material.angles is not None:
        tables["angles"] = plain_record(material.angles)
    if material.wavelengths is not None:
        tables["wavelengths"] = plain_numbers(material.wavelengths)
    return tables | {
        "surface": {name: plain_numbers(value) for name, value in surface.items()},
        "source": dict(source or {}),
        "fit": {
            "unit": VARIANCE_UNIT,
            **plain_record(material.gaussians),
            **({} if profile is None else {"profile": _description(profile)}),
            **({"coefficients_digest": digest} if (digest := digest_of(tables)) else {}),
            **{
                name: value if isinstance(value, str | int | float) else plain_numbers(value)
                for name, value in (fit or {}).items()
            },
        },
    }


def _tables(name_or_path: StrPath) -> Table:
    path = material_path(name_or_path)
    expect(
        path.suffix.lower() != ".mtlx",
        path,
        "is MaterialX, which is only written; copy its numbers to [openpbr] in a TOML file",
    )
    entries = read_toml(path, "check the path, or give a material (`splatjax materials`)")
    expect(
        not entries.keys() & {"splats", "camera", "material"},
        path,
        "is the file of a scene; give that of a material",
    )
    return Table(path, "", entries, MATERIAL_TABLES)


def _read(
    material: StrPath | Table,
) -> tuple[Table, dict[str, Array], Dipole | LayeredMultipole | Skin | Burley | None]:
    """Read the tables of a material, its surface and wavelengths, and its coefficients if it has
    any.
    """
    tables = material if isinstance(material, Table) else _tables(material)
    path, entries, profile = tables.path, tables.entries, None
    kinds = [KINDS[kind] for kind in KINDS if kind in entries]
    expect(len(kinds) < 2, path, f"has {' and '.join(kinds)}; give one of them")
    missing = f"has no {', '.join(KINDS.values())} or [fit]; give one"
    expect(kinds or "fit" in entries, path, missing)
    entries.setdefault("surface", {})
    table = tables.table("surface", _SURFACE)
    if "openpbr" in entries:
        entries["medium"], of_openpbr = plain_openpbr(tables.table("openpbr", OPENPBR_ENTRIES))
        table.entries.update(of_openpbr | table.entries)
        del entries["openpbr"]
    surface = {name: table.numbers(name) for name in table.entries}
    table.make(Material, SumOfGaussians([1.0], [[1.0]]), **surface)  # check the values
    roughness = surface.get("roughness")
    table.make(check_values, "roughness", roughness, "in (0, 1]", lambda x: (x > 0) & (x <= 1))
    if "medium" in entries:
        profile = Dipole(medium_of(tables.table("medium", MEDIUM_ENTRIES)))
    elif "skin" in entries:
        profile = tables.table("skin", record_names(Skin)).record(Skin)
    elif "burley" in entries:
        profile = burley_of(tables.table("burley", BURLEY_ENTRIES))
    elif "layers" in entries:
        layers = [layer_of(layer) for layer in tables.tables("layers", LAYER_ENTRIES)]
        with naming(f"{path}: [[layers]]"):
            profile = LayeredMultipole(layers)
    if "wavelengths" in entries:
        surface["wavelengths"] = nodes = tables.numbers("wavelengths")
        own = profile.wavelengths if isinstance(profile, Skin) else nodes
        expect(np.array_equal(own, nodes), path, f"has other wavelengths than its [skin]: {own}")
        channels = profile.medium.channels if isinstance(profile, Dipole) else nodes.size
        tables.make(Material, SumOfGaussians([1.0], [[1.0] * channels]), wavelengths=nodes)
    return tables, surface, profile


def _description(profile: _Stored) -> str:
    if isinstance(profile, Skin | Burley):
        return _MODELS[type(profile)]
    layers = f" of {len(profile.layers)} layers" if isinstance(profile, LayeredMultipole) else ""
    moments = "exact" if isinstance(profile.fresnel, ExactFresnel) else "fitted"
    return f"{_MODELS[type(profile)]}{layers}, {moments} Fresnel moments"
