"""The common parts of pages and widgets: their state, and the order of their pictures."""

import abc
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from splatjax.cache import watched_compiling

from ._controls import Controls
from ._saving import AsFile, save
from ._session import Session
from ._sliders import controls_of, pixel_rows


class Viewer:
    """A view of a session that shows a draft of each state immediately, and the full picture when
    nothing changes.

    A subclass adds sliders to `_handles` by name, and decides when to call `_finish`.

    **Arguments:**

    - `folder`: the only folder to which files are saved.
    - `as_file`: see `save`.
    """

    still = 0.15  # seconds without a change after which the full picture is computed

    def __init__(self, session: Session, folder: str | Path, as_file: AsFile | None = None):
        self._session, self._folder, self._as_file = session, Path(folder), as_file
        self._first_place = self._place = np.asarray([session.start.eye, session.start.target])
        self._picked: tuple[int, int] | None = None
        self._handles = dict[str, Any]()

    @property
    def controls(self) -> Controls:
        """Return the state of the sliders and of the camera."""
        values = {name: handle.value for name, handle in self._handles.items()}
        return controls_of(self._session.start, values, self._place)

    @abc.abstractmethod
    def _say(self, text: str) -> None:
        """Display the status."""

    @abc.abstractmethod
    def _show(self, picture: np.ndarray) -> None:
        """Display a picture."""

    @abc.abstractmethod
    def _show_pixel(self, rows: Sequence[Sequence[str]]) -> None:
        """Display the table of a pixel."""

    def _watched(self) -> AbstractContextManager[None]:
        """Display when a program is being compiled."""
        return watched_compiling(lambda: self._say("compiling, once for this and later starts ..."))

    def _report(self, action: Callable[[], str]) -> None:
        """Run a slow action, and display its result or its error."""
        try:
            with self._watched():
                self._say(action())
        except Exception as error:
            is_clear = isinstance(error, OSError | ValueError)
            self._say(str(error) if is_clear else f"{type(error).__name__}: {error}")

    def _finish(self, controls: Controls) -> str:
        """Show the full picture and the parts of the chosen pixel, and return the status."""
        picture = self._session.picture(controls)
        self._show(picture)
        if self._picked is not None:
            self._show_pixel(pixel_rows(self._session, controls, self._picked))
        return "" if picture.any() else "nothing is visible; the camera may be inside the body"

    def _save(self, saves: list[tuple[str, Controls]]) -> str:
        """Write and remove all entries, kinds and states, of a list, and return the status."""
        written = list[Path]()
        while saves:
            kind, controls = saves.pop(0)
            written += save(self._session, controls, self._folder, kind, self._as_file)
        return f"saved {', '.join(map(str, written))}" if written else ""
