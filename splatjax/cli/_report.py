"""What a command says while it works: on stderr, so that its results on stdout stay clean."""

import contextlib
import time
from collections.abc import Generator

from rich.console import Console


def _console() -> Console:
    return Console(stderr=True, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def stage(what: str) -> Generator[None, None, None]:
    """Show that something is being done, and afterwards how long it took."""
    console = _console()
    begin = time.perf_counter()
    with console.status(what):
        yield
    console.print(f"{what}: {time.perf_counter() - begin:.1f} s", markup=False)


def note(what: str) -> None:
    """Say something the user should know."""
    _console().print(what, markup=False)
