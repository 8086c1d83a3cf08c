"""The studio in a cell of a notebook."""

from pathlib import Path
from typing import TYPE_CHECKING

from splatjax._records import check_installed

from ._session import Session

if TYPE_CHECKING:
    from ._widget import Widget


def widget(session: Session, folder: str | Path = "studio") -> "Widget":
    """Show a session in a cell of a notebook: drag the picture to orbit, or with the right button
    to move, scroll to zoom, and click it for the parts of a pixel.

    Everything passes through the connection of the notebook, so that its kernel may run on another
    computer.

    **Arguments:**

    - `folder`: the only one to which the widget writes, under names of its own; made when needed.

    **Returns:** a widget of ipywidgets, whose `controls` are the state that it shows.

    **Raises:** `ValueError` where ipywidgets or jupyter_rfb is not installed.
    """
    for package in ("ipywidgets", "jupyter_rfb"):
        check_installed("a widget of the studio", package)
    from ._widget import Widget

    return Widget(session, folder)
