"""Messages of a command while it works: on stderr, so that its results on stdout stay clean."""

import contextlib
import time
from collections.abc import Callable, Generator, Sequence

from rich.console import Console

_CONSOLE = Console(stderr=True, highlight=False, soft_wrap=True)


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
