"""The studio in a notebook cell, with ipywidgets and jupyter_rfb. It communicates through the
notebook's connection, so the kernel may run on another computer.
"""

import asyncio
import contextlib
import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import ipywidgets
import numpy as np
from jupyter_rfb import RemoteFrameBuffer
from matplotlib.figure import Figure

from splatjax._format import CHANNEL_COLORS

from ._controls import LAYERS, Controls, orbited, shifted
from ._saving import SUFFIXES
from ._session import Session
from ._sliders import coefficient_lines, sliders
from ._viewer import Viewer

_LEFT, _RIGHT = (1,), (2,)  # mouse buttons
_CLICK = 3  # pixels that the mouse may move during a click


class _Canvas(RemoteFrameBuffer):
    """A picture that is drawn when the browser is ready for it."""

    def __init__(self, widget: "Widget", width: int, height: int):
        with contextlib.redirect_stdout(io.StringIO()):  # jupyter_rfb prints outside of notebooks
            super().__init__(
                resizable=False,
                cursor="grab",
                css_width=f"{width}px",
                css_height=f"{height}px",
            )
        self._widget = widget

    def get_frame(self) -> np.ndarray:
        return self._widget._draft()

    def handle_event(self, event: dict[str, Any]) -> None:
        self._widget._follow(event)


class Widget(Viewer, ipywidgets.HBox):
    """A session in a notebook cell, with the controls of a `Page`; see `widget`."""

    def __init__(self, session: Session, folder: str | Path):
        Viewer.__init__(self, session, folder)
        camera = session.camera(session.start)
        self._size = camera.width, camera.height
        self._canvas = _Canvas(self, *self._size)
        self._pressed: tuple[float, float] | None = None
        self._last = 0.0, 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._status = ipywidgets.Label()
        self._numbers, self._pixel, self._plot = (ipywidgets.HTML() for _ in range(3))
        below = ipywidgets.HBox(self._make_buttons())
        left = [self._canvas, below, self._status, self._pixel]
        right = [*self._make_sliders(), self._numbers, self._plot]
        for handle in self._handles.values():
            handle.observe(lambda _: self._canvas.request_draw(), "value")
        boxes = [ipywidgets.VBox(left), ipywidgets.VBox(right)]
        ipywidgets.HBox.__init__(self, boxes, layout={"flex_flow": "row wrap"})

    def _make_buttons(self) -> list[ipywidgets.Widget]:
        def button(name: str, tooltip: str | None, action: Callable[[], None]) -> ipywidgets.Button:
            made = ipywidgets.Button(description=name, tooltip=tooltip, layout={"width": "auto"})
            made.on_click(lambda _: action())
            return made

        first = button("first view", None, lambda: self._look(self._first_place))
        saves = [button(kind, f"save the {kind}", partial(self._write, kind)) for kind in SUFFIXES]
        return [first, ipywidgets.Label("save"), *saves]

    def _make_sliders(self) -> list[ipywidgets.Widget]:
        layer = ipywidgets.Dropdown(options=LAYERS, description="layer")
        self._handles["layer"], shown = layer, list[ipywidgets.Widget]([layer])
        for folder, of_folder in sliders(self._session).items():
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
            self._handles |= made
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
        self._timer = asyncio.get_running_loop().call_later(self.still, self._report, self._settle)
        with self._watched():
            return self._session.draft(self.controls)

    def _settle(self) -> str:
        controls = self.controls
        status = self._finish(controls)
        self._numbers.value = "<br>".join(coefficient_lines(controls))
        self._plot.value = self._drawn(controls)
        return status

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

    def _say(self, text: str) -> None:
        self._status.value = text

    def _show(self, picture: np.ndarray) -> None:
        self._canvas.send_frame(picture)

    def _show_pixel(self, rows: Sequence[Sequence[str]]) -> None:
        cells = ["".join(f"<td>{cell}&emsp;</td>" for cell in row) for row in rows]
        self._pixel.value = f"<table><tr>{'</tr><tr>'.join(cells)}</tr></table>"

    def _write(self, kind: str) -> None:
        self._say("saving ...")
        self._report(lambda: self._save([(kind, self.controls)]))

    def _look(self, place: np.ndarray) -> None:
        self._place = place
        self._canvas.request_draw()

    def _follow(self, event: dict[str, Any]) -> None:
        """Move the camera when the mouse is dragged, or choose the pixel that is clicked."""
        kind = event["type"]
        if kind == "wheel":
            target = self._place[1]
            self._look(target + (self._place - target) * np.exp(event["dy"] / 500))
        if not kind.startswith("pointer"):
            return
        at = event["x"], event["y"]
        across, down = np.subtract(at, self._last) / self._size[1]
        self._last = at
        if kind == "pointer_down":
            self._pressed = at
        elif kind == "pointer_move" and event["buttons"] == _LEFT:
            self._look(orbited(self._place, -180 * across, 180 * down))
        elif kind == "pointer_move" and event["buttons"] == _RIGHT:
            camera = self._session.camera(self.controls)
            self._look(shifted(self._place, across, down, camera))
        elif kind == "pointer_up" and self._pressed is not None:
            if np.hypot(*np.subtract(at, self._pressed)) < _CLICK:
                self._picked = int(at[0]), int(at[1])
                self._canvas.request_draw()
            self._pressed = None
