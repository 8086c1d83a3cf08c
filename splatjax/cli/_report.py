"""What a command says while it works: on stderr, so that its results on stdout stay clean."""

import contextlib
import time
from collections.abc import Callable, Generator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


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


@contextlib.contextmanager
def sweeps(total: int) -> Generator[Callable[[str, int], None], None, None]:
    """Show what is being done, with how much of a total. Gives what is to be told so; where nobody
    looks, each is a line.
    """
    console, begin = _console(), time.perf_counter()
    with console.status("looking") as status:

        def report(what: str, done: int) -> None:
            status.update(f"{what}: {done} of {total}")
            if done == total:
                console.print(
                    f"{what}: {total} splats, {time.perf_counter() - begin:.1f} s since the "
                    "beginning",
                    markup=False,
                )

        yield report


@contextlib.contextmanager
def progress(what: str, total: int) -> Generator[Callable[[], None], None, None]:
    """Show how many of equal steps are done, what one takes, and the time that is left. Gives what
    is to be called after each.

    Where nobody looks at a terminal, a line is printed for each.
    """
    console, begin, done = _console(), time.perf_counter(), 0

    def step() -> str:
        nonlocal begin, done
        begin, before, done = time.perf_counter(), begin, done + 1
        return f"{begin - before:.1f} s"

    if not console.is_terminal:
        yield lambda: console.print(f"{what}: {done + 1} of {total}, {step()}", markup=False)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[took]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(what, total=total, took="")
        yield lambda: bar.update(task, advance=1, took=step())
