"""What commands share: types of options as help shows them, checks of options and outputs before
the work begins, and messages while it lasts: on stderr, so that results on stdout stay clean.

What takes more than a line to explain is a `help`: breaks in docstrings are kept.
"""

import contextlib
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from splatjax.io import atomic_path

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
UpAxis = Literal["y", "z"]
# By field of a command, whether its value is valid, and what it must do.
Rules = dict[str, tuple[bool, str]]
# Suffixes of drawings.
FIGURES = (".png", ".pdf", ".svg")
_CONSOLE = Console(stderr=True, highlight=False, soft_wrap=True)


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


def save_figure(figure: Any, path: Path) -> None:
    """Write a drawing of matplotlib, whole or not at all, and print its path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower())
    print(path)


def note(what: str) -> None:
    """Print something the user should know."""
    _CONSOLE.print(what, markup=False)


@contextlib.contextmanager
def stage(what: str, total: int = 0) -> Generator[Callable[..., None]]:
    """Show that something is being done, and afterwards how long it took.

    Yields the function to call with the steps done of a total, and with what is being done where
    that changes. Where stderr is no terminal, it prints a line at most once a second.
    """
    begin = last = time.perf_counter()
    with _CONSOLE.status(what) as status:

        def report(done: int, what: str = what) -> None:
            nonlocal last
            now = time.perf_counter()
            left = (now - begin) / done * (total - done)
            line = f"{what}: {done} of {total}, {left:.0f} s left"
            status.update(line)
            if not _CONSOLE.is_terminal and (done == total or now > last + 1):
                last = now
                note(line)

        yield report
    note(f"{what}: {time.perf_counter() - begin:.1f} s")


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows on stdout, their columns aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join(cells).rstrip())
