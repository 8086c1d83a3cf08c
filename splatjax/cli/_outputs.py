"""Outputs are checked before the work begins: nobody should wait for a picture that cannot be
written.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from splatjax.io import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = (".png", ".pdf", ".svg")
"""Suffixes of drawings."""


def check_output(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raise `ValueError` for a name with another suffix or a folder in its place,
    `FileNotFoundError` for a missing folder.
    """
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name of this output must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file")


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a drawing, whole or not at all."""
    with atomic_path(path) as written:
        figure.savefig(written, format=path.suffix[1:].lower())
