"""The sliders beside the picture, and what they stand for."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from splatjax._format import CHANNEL_COLORS, channel_names, format_numbers
from splatjax.diffusion import ShapeDiffuser
from splatjax.scattering import Medium

from ._controls import COEFFICIENTS, LAYERS, Controls
from ._session import Session

_MOST, _STOPS = 4.0, 8.0  # powers of 2, of coefficients and of light
_LARGEST_G = 0.95
_SLIDERS = {
    "turn": ("turn lights, °", -180.0, 180.0),
    "exposure": ("exposure, stops", -_STOPS, _STOPS),
    "scale": ("diffuse", 0.0, 1.0),
    "specular": ("specular", 0.0, 1.0),
    "roughness": ("roughness", 0.05, 1.0),
    "eta": ("eta", 1.0, 2.5),
}
# Labels and ends of the pigments' sliders.
_PIGMENTS = {
    "melanin": ("melanin", 0.0, 0.5),
    "blood": ("blood", 0.0, 0.1),
    "oxygenation": ("oxygenation", 0.0, 1.0),
    "eumelanin": ("eumelanin", 0.0, 1.0),
    "bilirubin": ("bilirubin, g/l", 0.0, 0.3),
    "thickness": ("epidermis, mm", 0.01, 0.5),
    "scattering": ("scattering, /mm", 0.5, 15.0),
}


class Panel:
    """Sliders for the controls of a session, with numbers and a drawing of the profile.

    **Arguments:**

    - `gui`: viser's.
    - `changed`: called when a slider moves.

    **Attributes:**

    - `handles`: the sliders, by name.
    """

    def __init__(self, gui: Any, session: Session, changed: Callable[[], None]):
        self._session, start = session, session.start
        self.handles = handles = {"layer": gui.add_dropdown("layer", LAYERS)}

        def add(name: str, label: str, low: float, high: float, value: float, step: float = 0.01):
            handles[name] = gui.add_slider(label, min(low, value), max(high, value), step, value)

        # The diffusion equation knows no weights.
        has_weights = not isinstance(session.settings.diffuser, ShapeDiffuser)
        for name, slider in _SLIDERS.items():
            if name != "scale" or has_weights:
                add(name, *slider, getattr(start, name))
        lights = session.own.lights if len(start.light_stops) > 1 else ()
        for number, light in enumerate(lights):
            label = f"{type(light).__name__.removesuffix('Light').lower()} {number + 1}, stops"
            add(f"light {number}", label, -_STOPS, _STOPS, 0.0)
        if start.skin:
            with gui.add_folder("skin"):
                for name, value in start.skin:
                    add(f"skin {name}", *_PIGMENTS[name], value, step=0.001)
        names = ("all", *channel_names(session.own.material.channels)) if start.sigma_a else ()
        for field, label in COEFFICIENTS.items() if names else ():
            with gui.add_folder(f"{label}, by powers of 2", expand_by_default=False):
                for number, name in enumerate(names):
                    add(f"{field} {number}", name, -_MOST, _MOST, 0.0)

        if names:
            add("g", "g, mean cosine", -_LARGEST_G, _LARGEST_G, start.g)
        widths = np.sqrt(session.own.material.gaussians.variances).tolist() if has_weights else ()
        with gui.add_folder("weights, by factors", expand_by_default=False, visible=has_weights):
            for number, width in enumerate(widths):
                add(f"factor {number}", f"{width:.2g} mm", 0.0, 2.0, 1.0)

        def moved(event: Any) -> None:
            handle = event.target
            if hasattr(handle, "min"):  # its box takes any number
                handle.value = min(max(handle.value, handle.min), handle.max)
            changed()

        for handle in handles.values():
            handle.on_update(moved)
        self._numbers = gui.add_markdown("")

    def add_plot(self, gui: Any) -> None:
        """Add the drawing of the profile and its fit."""
        curves, channels = (
            self._session.curves(self._session.start),
            self._session.own.material.channels,
        )
        profiles, hidden = len(curves) - 1 - channels, {"points": {"show": False}}
        series = [
            {"stroke": CHANNEL_COLORS[i % channels % 3] + opacity, "width": width, **hidden}
            for i in range(profiles + channels)
            for opacity, width in [("60", 6) if i < profiles else ("", 1.5)]
        ]
        ends = float(curves[0][0]), float(curves[0][-1])
        self._plot = gui.add_uplot(
            tuple(curves),
            ({"label": "r"}, *series),
            title="r R(r) over r in mm, and its fit (narrow)",
            scales={"x": {"time": False, "distr": 3, "range": ends}},
            legend={"show": False},
            aspect=1.8,
        )

    def controls(self, place: np.ndarray) -> Controls:
        """Return the state that the sliders and a camera's place and target give."""
        values = {name: handle.value for name, handle in self.handles.items()}
        start, (eye, target) = self._session.start, place.tolist()
        changed = {name: value for name, value in values.items() if " " not in name}
        for field in COEFFICIENTS:
            changed[field] = tuple(
                number * 2 ** (values[f"{field} 0"] + values[f"{field} {channel}"])
                for channel, number in enumerate(getattr(start, field), 1)
            )
        changed["skin"] = tuple((name, values[f"skin {name}"]) for name, _ in start.skin)
        stops = tuple(value for name, value in values.items() if name.startswith("light "))
        changed["light_stops"] = stops or start.light_stops
        factors = tuple(value for name, value in values.items() if name.startswith("factor "))
        changed["factors"] = factors or start.factors
        return dataclasses.replace(start, eye=tuple(eye), target=tuple(target), **changed)

    def show(self, controls: Controls) -> None:
        """Show the coefficients and the profile of a state."""
        self._plot.data = tuple(self._session.curves(controls))
        rows = [(label, getattr(controls, field)) for field, label in COEFFICIENTS.items()]
        shown = [f"{label}: {format_numbers(row, '.4g')} /mm" for label, row in rows if row]
        self._numbers.content = "  \n".join(shown)

    def set_medium(self, medium: Medium) -> None:
        """Move the sliders to the coefficients of a medium."""
        for field in COEFFICIENTS:
            start = np.asarray(getattr(self._session.start, field))
            powers = np.log2(np.asarray(getattr(medium, field)) / start)
            for number, power in enumerate([0.0, *np.clip(powers, -_MOST, _MOST).tolist()]):
                self.handles[f"{field} {number}"].value = power
