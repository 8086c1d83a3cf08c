"""The sliders of a page, by viser."""

import itertools
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any

from splatjax._format import CHANNEL_COLORS

from ._controls import LAYERS, Controls
from ._session import Session
from ._sliders import coefficient_lines, sliders


class Panel:
    """Sliders for the controls of a session, with numbers and a drawing of the profile.

    **Arguments:**

    - `gui`: viser's.
    - `changed`: called when a slider moves.

    **Attributes:**

    - `handles`: the sliders, by name.
    """

    def __init__(self, gui: Any, session: Session, changed: Callable[[], None]):
        self._session = session
        self.handles = handles = {"layer": gui.add_dropdown("layer", LAYERS)}
        for folder, of_folder in itertools.groupby(sliders(session), lambda each: each.folder):
            is_open = folder == "skin"
            with gui.add_folder(folder, expand_by_default=is_open) if folder else nullcontext():
                for name, label, low, high, value, _, step in of_folder:
                    handles[name] = gui.add_slider(label, low, high, step, value)

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

    @property
    def values(self) -> dict[str, Any]:
        return {name: handle.value for name, handle in self.handles.items()}

    def move(self, values: Mapping[str, float]) -> None:
        """Move sliders, by name."""
        for name, value in values.items():
            self.handles[name].value = value

    def show(self, controls: Controls) -> None:
        """Display the coefficients and the profile of a state."""
        self._plot.data = tuple(self._session.curves(controls))
        self._numbers.content = "  \n".join(coefficient_lines(controls))
