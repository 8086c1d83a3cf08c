"""Messages of a command while it works: on stderr, so that its results on stdout stay clean."""

import contextlib
import time
from collections.abc import Callable, Generator, Iterable, Sequence

from rich.console import Console
from rich.table import Table


def _console() -> Console:
    return Console(stderr=True, highlight=False, soft_wrap=True)


def note(what: str) -> None:
    """Print something the user should know."""
    _console().print(what, markup=False)


@contextlib.contextmanager
def stage(what: str, total: int = 0) -> Generator[Callable[..., None]]:
    """Show that something is being done, and afterwards how long it took.

    Yields the function to call with the steps done of a total, and with what is being done where
    that changes. Where stderr is no terminal, it prints a line at most once a second.
    """
    console, begin = _console(), time.perf_counter()
    last = begin
    with console.status(what) as status:

        def report(done: int, what: str = what) -> None:
            nonlocal last
            now = time.perf_counter()
            left = (now - begin) / done * (total - done)
            line = f"{what}: {done} of {total}, {left:.0f} s left"
            status.update(line)
            if not console.is_terminal and (done == total or now > last + 1):
                last = now
                note(line)

        yield report
    note(f"{what}: {time.perf_counter() - begin:.1f} s")


def print_table(columns: dict[str, str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table on stdout, each column by its title and justification."""
    table = Table(box=None, pad_edge=False)
    for title, justify in columns.items():
        table.add_column(title, justify=justify, no_wrap=True)  # ty: ignore[invalid-argument-type]
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = 200  # in a pipe, a line stays whole
    console.print(table)
