"""Types of options, as help shows them; checks of options and outputs before the work begins.

What takes more than a line to explain is a `help`: breaks in docstrings are kept.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from splatjax.io import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
UpAxis = Literal["y", "z"]
Rules = dict[str, tuple[bool, str]]
"""By field of a command, whether its value is valid, and what it must do."""
FIGURES = (".png", ".pdf", ".svg")
"""Suffixes of drawings."""


def option_name(field: str) -> str:
    """Return how a field of a command is typed: `light_azimuth` is `--light-azimuth`."""
    return f"--{field.replace('_', '-')}"


def check_options(command: Any, rules: Rules) -> None:
    """Raise `ValueError` for the first option that breaks its rule."""
    for field, (is_valid, expected) in rules.items():
        if not is_valid:
            value = getattr(command, field)
            given = f"{value:g}" if isinstance(value, float) else value
            raise ValueError(f"{option_name(field)} is {given}; it must {expected}")


def check_output(path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Raise `ValueError` for a name with another suffix or a folder in its place,
    `FileNotFoundError` for a missing folder; nothing for no output.
    """
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name of this output must end in {' or '.join(suffixes)}")
    check_folder(path)
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file")


def check_folder(path: Path) -> None:
    """Raise `FileNotFoundError` where the folder of an output is missing."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}; make it first")


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a drawing, whole or not at all, and print its path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower())
    print(path)
