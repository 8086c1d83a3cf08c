"""The tables [medium], [openpbr], [burley] and [[layers]] of materials, which contain optical
coefficients, or a color and a length.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from splatjax._library import profiles_folder
from splatjax._records import check_values
from splatjax.exports import plain_numbers
from splatjax.fitting import DipoleStarts
from splatjax.scattering import (
    Burley,
    Film,
    HalfSpace,
    Layer,
    Medium,
    diffuse_mean_free_path_scaling,
    diffuse_scaling,
    searchlight_scaling,
)

from ._files import plain_record
from ._tables import Table

KINDS = {k: f"[{k}]" for k in ("medium", "openpbr", "burley", "skin")} | {"layers": "[[layers]]"}
COEFFICIENT_UNIT, THICKNESS_UNIT = "1/mm", "mm"
_PER_MM = {COEFFICIENT_UNIT: 1.0, "1/cm": 0.1}
_WAYS = (
    {"sigma_a", "sigma_s_prime"},
    {"sigma_a", "sigma_s", "g"},
    {"color", "mean_free_path"},
)
_MM = {THICKNESS_UNIT: 1.0, "cm": 10.0, "m": 1000.0}
# Entries for the subsurface of an OpenPBR material, with the defaults of OpenPBR 1.1.
_OPENPBR: dict[str, Any] = {
    "subsurface_color": 0.8,
    "subsurface_radius": 1.0,
    "subsurface_radius_scale": [1.0, 0.5, 0.25],
    "specular_ior": 1.5,
    "subsurface_scatter_anisotropy": 0.0,
}
# OpenPBR's entries for the surface, and the exponents that convert them to entries of [surface].
_OF_SURFACE = (("specular_weight", "specular", 1), ("specular_roughness", "roughness", 2))
OPENPBR_ENTRIES = ("unit", *_OPENPBR, "subsurface_weight", *(name for name, *_ in _OF_SURFACE))
# Lengths of normalized diffusion, divided by `d`: Unity's HDRP; Unreal; Christensen and Burley
# 2015; Blender (`exports.blender_radius`).
_BURLEY: dict[str, Callable[[Array], Array]] = {
    "scattering_distance": jnp.ones_like,
    "diffuse_mean_free_path": diffuse_mean_free_path_scaling,
    "mean_free_path": searchlight_scaling,
    "radius": lambda albedo: 4 * jnp.pi * diffuse_scaling(albedo),
}
BURLEY_ENTRIES = "unit", "albedo", *_BURLEY
MEDIUM_ENTRIES = ("unit", "eta", *sorted(set().union(*_WAYS)))
LAYER_ENTRIES = (*MEDIUM_ENTRIES, "optical_depth", "thickness", "thickness_unit")


def medium_of(table: Table) -> Medium:
    """Make a medium from a table with reduced scattering, with scattering and mean cosine, or with
    a color and a mean free path.
    """
    names = (table.entries.keys() & set().union(*_WAYS)) - {"g"}
    table.expect(
        names in [way - {"g"} for way in _WAYS] and ("sigma_s" in names) <= ("g" in table.entries),
        f"has {', '.join(sorted(names)) or 'no coefficients'}; give sigma_a and sigma_s_prime, or "
        "sigma_a, sigma_s and g, or color and mean_free_path",
    )
    unit = table.one_of("unit", [THICKNESS_UNIT] if "color" in names else _PER_MM)
    eta, g = table.numbers("eta"), table.number("g", 0.0)
    between = "between -1 and 1, both excluded"
    table.make(check_values, "g", np.asarray(g), between, lambda x: abs(x) < 1)
    if "color" in names:
        color, mean_free_path = table.numbers("color"), table.numbers("mean_free_path")
        return table.make(HalfSpace.of_color, color, mean_free_path, eta, g).medium
    per_mm, reduced = _PER_MM[unit], "sigma_s_prime"
    sigma_a, factor = per_mm * table.numbers("sigma_a"), per_mm
    if "sigma_s" in names:
        reduced, factor = "sigma_s", per_mm * (1 - g)
    return table.make(Medium, sigma_a, factor * table.numbers(reduced), eta)


def plain_openpbr(table: Table) -> tuple[dict[str, Any], dict[str, float]]:
    """Convert the table of an OpenPBR material to a [medium] and the entries of [surface] that it
    specifies.
    """
    table.expect(
        table.number("subsurface_weight", 1.0) == 1,
        "subsurface_weight must be 1; mixtures with an opaque surface are not supported",
    )
    per_unit = _MM[table.one_of("unit", _MM)]
    table.number("subsurface_radius", 1.0)  # raises if it is not one number
    color, radius, scale, eta, g = (table.numbers(*entry) for entry in _OPENPBR.items())
    medium = {"color": color, "mean_free_path": per_unit * radius * scale, "eta": eta, "g": g}
    plain = {name: values.tolist() for name, values in medium.items()}
    surface = {
        name: table.number(entry) ** power
        for entry, name, power in _OF_SURFACE
        if entry in table.entries
    }
    return {"unit": THICKNESS_UNIT, **plain}, surface


def burley_of(table: Table) -> Burley:
    """Make normalized diffusion from a table with an albedo and a length."""
    names = [name for name in _BURLEY if name in table.entries]
    fault = f"has {' and '.join(names) or 'no length'}; give one of {', '.join(_BURLEY)}"
    table.expect(len(names) == 1, fault)
    length = _MM[table.one_of("unit", _MM)] * table.numbers(names[0])
    return table.make(Burley, table.numbers("albedo"), length, _BURLEY[names[0]])


def plain_burley(profile: Burley) -> dict[str, Any]:
    return {
        "unit": THICKNESS_UNIT,
        "albedo": plain_numbers(profile.albedo),
        "scattering_distance": plain_numbers(profile.length_scale()),
    }


def layer_of(table: Table) -> Layer | Film:
    """Make a layer or film from a table."""
    if "optical_depth" in table.entries:
        return table.record(Film)
    table.expect(
        not {"g", "sigma_s_prime"} <= table.entries.keys(),
        "has g and sigma_s_prime, but layers only have reduced scattering; leave g out, or give "
        "sigma_s and g",
    )
    table.one_of("thickness_unit", [THICKNESS_UNIT])
    layer = table.record(Layer, medium=medium_of(table))
    table.make(layer.check_diffusion)
    return layer


def plain_medium(medium: Medium) -> dict[str, Any]:
    return {"unit": COEFFICIENT_UNIT, **plain_record(medium)}


def plain_layer(layer: Layer | Film) -> dict[str, Any]:
    if isinstance(layer, Film):
        return plain_record(layer)
    thickness = plain_record(layer, medium=None)
    return {**thickness, "thickness_unit": THICKNESS_UNIT, **plain_medium(layer.medium)}


def digest_of(tables: Mapping[str, Any]) -> str | None:
    """Compute a digest of the coefficients in the tables of a material; `None` if there are
    none.
    """
    optics = {kind: tables[kind] for kind in KINDS if kind in tables}
    plain = json.dumps(optics, sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:16] if optics else None


def dipole_starts() -> DipoleStarts:
    r"""Read the starts of fits of 1 to 8 Gaussians to dipoles, with which one descent replaces a
    search.

        fit_gaussians(Dipole(medium), 6, spread=VariancesPerChannel(), start=dipole_starts()(medium,
        6))

    **Returns:** a `DipoleStarts` in JAX's default precision, made by `tools/make_profiles.py`.
    """
    with np.load(profiles_folder() / "dipole_starts.npz") as file:
        tables = {name: jnp.asarray(table, float) for name, table in file.items()}
    counts = sum(name.startswith("log_variances_") for name in tables)
    log_variances = tuple(tables[f"log_variances_{count}"] for count in range(1, counts + 1))
    return DipoleStarts(tables["roots"], tables["etas"], log_variances)
