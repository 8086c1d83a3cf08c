"""Sliders and tables that pages and widgets share."""

import dataclasses
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from splatjax._format import channel_names, format_numbers
from splatjax.diffusion import ShapeDiffuser
from splatjax.scattering import Medium

from ._controls import COEFFICIENTS, Controls, plain
from ._session import Session

_MOST, _STOPS = 4.0, 8.0  # ranges in powers of 2, of coefficients and of light
_LARGEST_G = 0.95
_LEAST = 1e-30  # 1/mm: avoids division by 0
_GENERAL = {
    "turn": ("turn lights, °", -180.0, 180.0),
    "exposure": ("exposure, stops", -_STOPS, _STOPS),
    "scale": ("diffuse", 0.0, 1.0),
    "specular": ("specular", 0.0, 1.0),
    "roughness": ("roughness", 0.05, 1.0),
    "eta": ("eta", 1.0, 2.5),
}
# Labels and ranges of the sliders of pigments.
_PIGMENTS = {
    "melanin": ("melanin", 0.0, 0.5),
    "blood": ("blood", 0.0, 0.1),
    "oxygenation": ("oxygenation", 0.0, 1.0),
    "eumelanin": ("eumelanin", 0.0, 1.0),
    "bilirubin": ("bilirubin, g/l", 0.0, 0.3),
    "thickness": ("epidermis, mm", 0.01, 0.5),
    "scattering": ("scattering, /mm", 0.5, 15.0),
}


class Slider(NamedTuple):
    """A slider for a number of a state, which `controls_of` looks up by `name`."""

    name: str
    label: str
    low: float
    high: float
    value: float
    step: float = 0.01


def sliders(session: Session) -> dict[str, list[Slider]]:
    """List the sliders of a session by folder. Those under "" are in no folder."""
    start, folders = session.start, defaultdict[str, list[Slider]](list)

    def add(folder: str, name: str, label: str, low: float, high: float, value: float, *step):
        slider = Slider(name, label, min(low, value), max(high, value), value, *step)
        folders[folder].append(slider)

    # The diffusion equation does not use weights.
    has_weights = not isinstance(session.settings.diffuser, ShapeDiffuser)
    for name, slider in _GENERAL.items():
        if name != "scale" or has_weights:
            add("", name, *slider, getattr(start, name))
    if start.sigma_a:
        add("", "g", "g, mean cosine", -_LARGEST_G, _LARGEST_G, start.g)
    for number, light in enumerate(session.own.lights if len(start.light_stops) > 1 else ()):
        label = f"{type(light).__name__.removesuffix('Light').lower()} {number + 1}, stops"
        add("", f"light {number}", label, -_STOPS, _STOPS, 0.0)
    for name, value in start.skin:
        add("skin", f"skin {name}", *_PIGMENTS[name], value, 0.001)
    names = ("all", *channel_names(session.own.material.channels)) if start.sigma_a else ()
    for field, label in COEFFICIENTS.items():
        for number, name in enumerate(names):
            add(f"{label}, by powers of 2", f"{field} {number}", name, -_MOST, _MOST, 0.0)
    widths = np.sqrt(session.own.material.gaussians.variances).tolist() if has_weights else ()
    for number, width in enumerate(widths):
        add("weights, by factors", f"factor {number}", f"{width:.2g} mm", 0.0, 2.0, 1.0)
    return folders


def controls_of(start: Controls, values: Mapping[str, Any], place: np.ndarray) -> Controls:
    """Make a state from the values of sliders and the position and target of a camera."""
    changed = {name: value for name, value in values.items() if " " not in name}
    for field in COEFFICIENTS:
        changed[field] = tuple(
            number * 2 ** (values[f"{field} 0"] + values[f"{field} {channel}"])
            for channel, number in enumerate(getattr(start, field), 1)
        )
    changed["skin"] = tuple((name, values[f"skin {name}"]) for name, _ in start.skin)
    for field, prefix in (("light_stops", "light "), ("factors", "factor ")):
        of_field = tuple(value for name, value in values.items() if name.startswith(prefix))
        changed[field] = of_field or getattr(start, field)
    return dataclasses.replace(start, eye=plain(place[0]), target=plain(place[1]), **changed)


def values_of_medium(start: Controls, medium: Medium) -> dict[str, float]:
    """Return the values of sliders for the coefficients of a medium, clamped to their ranges. A
    coefficient that is 0 at the start stays 0, because sliders are factors.
    """
    values = dict[str, float]()
    for field in COEFFICIENTS:
        found, first = (np.maximum(getattr(x, field), _LEAST) for x in (medium, start))
        powers = np.log2(found / first)
        for number, power in enumerate([0.0, *np.clip(powers, -_MOST, _MOST).tolist()]):
            values[f"{field} {number}"] = power
    return values


def coefficient_lines(controls: Controls) -> list[str]:
    """Format the coefficients of a state."""
    rows = [(label, getattr(controls, field)) for field, label in COEFFICIENTS.items()]
    return [f"{label}: {format_numbers(row, '.4g')} /mm" for label, row in rows if row]


def pixel_rows(session: Session, controls: Controls, pixel: tuple[int, int]) -> list[list[str]]:
    """Tabulate the parts of a pixel under their titles; a single cell if it shows no surface."""
    parts, title = session.pixel(controls, *pixel), "pixel {}, {}".format(*pixel)
    if not np.any(parts["radiance"]):
        return [[f"{title} shows no surface"]]
    rows = [[name, *(f"{value:.3g}" for value in values)] for name, values in parts.items()]
    return [[title, *channel_names(len(parts["radiance"]))], *rows]
