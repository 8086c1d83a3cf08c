"""The studio in a cell of a notebook."""

from pathlib import Path
from typing import TYPE_CHECKING

from splatjax._records import check_installed

from ._session import Session

if TYPE_CHECKING:
    from ._widget import Widget


def widget(session: Session, folder: str | Path = "studio") -> "Widget":
    """Show a session in a cell of a notebook. Drag the picture to orbit, or with the right button
    to pan; scroll to zoom; click for the parts of a pixel.

    The widget communicates through the notebook's own connection, so that the kernel may run on
    another computer.

    **Arguments:**

    - `folder`: the only folder to which the widget writes, under names that it chooses; created
      when needed.

    **Returns:** an ipywidgets widget. Its `controls` are the state that it shows.

    **Raises:** `ValueError` if ipywidgets or jupyter_rfb is not installed.
    """
    for package in ("ipywidgets", "jupyter_rfb"):
        check_installed("a widget of the studio", package)
    from ._widget import Widget

    return Widget(session, folder)
