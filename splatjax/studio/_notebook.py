"""The studio in a notebook cell."""

from pathlib import Path
from typing import TYPE_CHECKING

from splatjax._records import check_installed

from ._session import Session

if TYPE_CHECKING:
    from ._widget import Widget


def widget(session: Session, folder: str | Path = "studio") -> "Widget":
    """Show a session in a notebook cell. Drag the picture to orbit, or with the right button to
    pan; scroll to zoom; click to list the parts of a pixel.

    The widget communicates through the notebook's connection, so the kernel may run on another
    computer.

    **Arguments:**

    - `folder`: the only folder to which the widget writes, under names that it chooses; created if
      missing.

    **Returns:** an ipywidgets widget, whose `controls` are its current state.

    **Raises:** `ValueError` if ipywidgets or jupyter_rfb is not installed.
    """
    for package in ("ipywidgets", "jupyter_rfb"):
        check_installed("a widget of the studio", package)
    from ._widget import Widget

    return Widget(session, folder)
