"""The studio in a cell of a notebook, by ipywidgets and jupyter_rfb. It communicates through the
notebook's own connection, so that the kernel may run on another computer.
"""

import asyncio
import contextlib
import io
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ipywidgets
import numpy as np
from jupyter_rfb import RemoteFrameBuffer
from matplotlib.figure import Figure

from splatjax._format import CHANNEL_COLORS
from splatjax.cache import watched_compiling

from ._controls import LAYERS, Controls, orbited, shifted, zoomed
from ._saving import SUFFIXES, save
from ._session import Session
from ._sliders import (
    COMPILING,
    STILL,
    UNSEEN,
    coefficient_lines,
    controls_of,
    pixel_rows,
    sentence_of,
    sliders,
)

_LEFT, _RIGHT = (1,), (2,)  # buttons of a mouse
_CLICK = 3  # pixels by which a mouse may move in a click


class _Canvas(RemoteFrameBuffer):
    """A picture that is drawn when the browser is ready for it."""

    def __init__(self, widget: "Widget", width: int, height: int):
        size = {"css_width": f"{width}px", "css_height": f"{height}px"}
        with contextlib.redirect_stdout(io.StringIO()):  # outside of a notebook it prints
            super().__init__(resizable=False, cursor="grab", **size)
        self._widget = widget

    def get_frame(self) -> np.ndarray:
        return self._widget._draft()

    def handle_event(self, event: dict[str, Any]) -> None:
        self._widget._follow(event)


class Widget(ipywidgets.HBox):
    """A session in a cell of a notebook, with the controls of a `Page`. See `widget`."""

    def __init__(self, session: Session, folder: str | Path):
        self._session, self._folder = session, Path(folder)
        self._place = self._first_place = np.asarray([session.start.eye, session.start.target])
        camera = session.camera(session.start)
        self._size = camera.width, camera.height
        self._canvas = _Canvas(self, *self._size)
        self._pressed: tuple[float, float] | None = None
        self._last, self._picked = (0.0, 0.0), None
        self._timer: asyncio.TimerHandle | None = None
        self._layer = ipywidgets.Dropdown(options=LAYERS, description="layer")
        self._sliders = dict[str, ipywidgets.FloatSlider]()
        self._status = ipywidgets.Label()
        self._numbers, self._pixel, self._plot = (ipywidgets.HTML() for _ in range(3))
        buttons = [ipywidgets.Button(description=name) for name in ("first view", *SUFFIXES)]
        buttons[0].on_click(lambda _: self._look(self._first_place))
        for button, kind in zip(buttons[1:], SUFFIXES, strict=True):
            button.on_click(lambda _, kind=kind: self._save(kind))
            button.tooltip = f"save the {kind}"
        for button in buttons:
            button.layout.width = "auto"
        below = ipywidgets.HBox([buttons[0], ipywidgets.Label("save"), *buttons[1:]])
        left = [self._canvas, below, self._status, self._pixel]
        right = [self._layer, *self._add_sliders(), self._numbers, self._plot]
        for control in (self._layer, *self._sliders.values()):
            control.observe(lambda _: self._canvas.request_draw(), "value")
        boxes = [ipywidgets.VBox(left), ipywidgets.VBox(right)]
        super().__init__(boxes, layout={"flex_flow": "row wrap"})

    @property
    def controls(self) -> Controls:
        """The state of the sliders and of the camera."""
        values = {name: slider.value for name, slider in self._sliders.items()}
        values |= {"layer": self._layer.value}
        return controls_of(self._session.start, values, self._place)

    def _add_sliders(self) -> list[ipywidgets.Widget]:
        shown = list[ipywidgets.Widget]()
        for folder, group in itertools.groupby(sliders(self._session), lambda each: each.folder):
            of_folder = list(group)
            made = {
                each.name: ipywidgets.FloatSlider(
                    each.value,
                    min=each.low,
                    max=each.high,
                    step=each.step,
                    description=each.label,
                    readout_format=".3f" if each.step < 0.01 else ".2f",
                    style={"description_width": "8em"},
                    layout={"width": "25em"},
                )
                for each in of_folder
            }
            self._sliders |= made
            box = ipywidgets.VBox(list(made.values()))
            is_open = 0 if folder == "skin" else None
            shown.append(
                ipywidgets.Accordion([box], titles=[folder], selected_index=is_open)
                if folder
                else box
            )
        return shown

    def _draft(self) -> np.ndarray:
        """Compute a draft, and schedule the full picture for when nothing moves."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(STILL, self._settle)
        with watched_compiling(self._note_compiling):
            return self._session.draft(self.controls)

    def _settle(self) -> None:
        self._report(self._show_all)

    def _report(self, action: Callable[[], str]) -> None:
        """Run a slow action, and show the text that it returns or its error."""
        try:
            with watched_compiling(self._note_compiling):
                self._status.value = action()
        except Exception as error:
            self._status.value = sentence_of(error)

    def _show_all(self) -> str:
        controls = self.controls
        picture = self._session.picture(controls)
        self._canvas.send_frame(picture)
        self._numbers.value = "<br>".join(coefficient_lines(controls))
        self._plot.value = self._drawn(controls)
        if self._picked is not None:
            rows = pixel_rows(self._session, controls, self._picked)
            cells = ["".join(f"<td>{cell}&emsp;</td>" for cell in row) for row in rows]
            self._pixel.value = f"<table><tr>{'</tr><tr>'.join(cells)}</tr></table>"
        return "" if picture.any() else UNSEEN

    def _drawn(self, controls: Controls) -> str:
        """Plot the profile and its fit as SVG."""
        radii, *rows = self._session.curves(controls)
        channels = self._session.own.material.channels
        figure = Figure(figsize=(4.2, 2.4), layout="constrained")
        axes = figure.add_subplot(xlabel="r (mm)", ylabel="r R(r) (1/mm)")
        for number, row in enumerate(rows):
            is_profile = number < len(rows) - channels
            style = {"alpha": 0.35, "linewidth": 5} if is_profile else {"linewidth": 1.2}
            axes.semilogx(radii, row, color=CHANNEL_COLORS[number % channels % 3], **style)
        text = io.StringIO()
        figure.savefig(text, format="svg")
        return text.getvalue()

    def _note_compiling(self) -> None:
        self._status.value = COMPILING

    def _save(self, kind: str) -> None:
        def write() -> str:
            self._folder.mkdir(exist_ok=True)
            paths = save(self._session, self.controls, self._folder, kind)
            return f"saved {', '.join(map(str, paths))}"

        self._status.value = "saving ..."
        self._report(write)

    def _look(self, place: np.ndarray) -> None:
        self._place = place
        self._canvas.request_draw()

    def _follow(self, event: dict[str, Any]) -> None:
        """Move the camera as the mouse is dragged, or choose the pixel that is clicked."""
        kind = event["type"]
        if kind == "wheel":
            self._look(zoomed(self._place, event["dy"] / 500))
        if not kind.startswith("pointer"):
            return
        at, (x, y) = (event["x"], event["y"]), self._last
        across, down = (at[0] - x) / self._size[1], (at[1] - y) / self._size[1]
        self._last = at
        if kind == "pointer_down":
            self._pressed = at
        elif kind == "pointer_move" and event["buttons"] == _LEFT:
            self._look(orbited(self._place, -180 * across, 180 * down))
        elif kind == "pointer_move" and event["buttons"] == _RIGHT:
            self._look(shifted(self._place, across, down, self._session.fov))
        elif kind == "pointer_up" and self._pressed is not None:
            if np.hypot(*np.subtract(at, self._pressed)) < _CLICK:
                self._picked = int(at[0]), int(at[1])
                self._canvas.request_draw()
            self._pressed = None
