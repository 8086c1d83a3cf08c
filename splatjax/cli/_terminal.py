"""Common parts of the commands: types of options for the help, checks of options and outputs,
messages on stderr, results on stdout, and resumable commands that write many files and that several
processes can share.

Multi-line explanations are in `help`, because the help keeps line breaks of docstrings.
"""

import contextlib
import functools
import os
import re
import time
from collections.abc import Callable, Container, Generator, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro
from jax.extend.backend import clear_backends
from rich.console import Console

import splatjax as sj

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
UpAxis = Literal["y", "z"]
# For each field of a command, whether its value is valid, and the requirement.
Rules = dict[str, tuple[bool, str]]
# Suffixes of figures.
FIGURES = (".png", ".pdf", ".svg")
CONSOLE = Console(stderr=True, highlight=False, soft_wrap=True)


def option_name(field: str) -> str:
    """Return the option for a field of a command; `light_azimuth` becomes `--light-azimuth`."""
    return f"--{field.replace('_', '-')}"


def check_options(command: Any, rules: Rules) -> None:
    """Raise `ValueError` for the first option that breaks its rule."""
    for field, (is_valid, expected) in rules.items():
        if not is_valid:
            value = getattr(command, field)
            formatted = f"{value:g}" if isinstance(value, float) else value
            raise ValueError(f"{option_name(field)} is {formatted}; it must {expected}")


def check_unused(command: Any, names: Container[str], reason: str) -> None:
    """Raise `ValueError` for the first of the named options that is given but would have no
    effect.
    """
    for field in fields(command):
        value = getattr(command, field.name)
        if field.name in names and field.default not in (value, MISSING):
            raise ValueError(
                f"{option_name(field.name)} is {value}, but {reason}; leave the option out"
            )


def check_output(path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Raise `ValueError` for an output with another suffix or with the name of a folder, and
    `FileNotFoundError` if its folder is missing.
    """
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name of this output must end in {' or '.join(suffixes)}")
    check_folder(path)
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; give the name of a file")


def check_folder(path: Path) -> None:
    """Raise `FileNotFoundError` if the folder of an output is missing."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}; make it first")


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure atomically, and print its path."""
    with sj.io.atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower())
    print(path)


def note(message: str) -> None:
    """Print a message to the user."""
    CONSOLE.print(message, markup=False)


@contextlib.contextmanager
def stage(title: str, total: int = 0) -> Generator[Callable[..., None]]:
    """Report a stage of the work, and its duration when it ends.

    Yield a function that takes the number of finished steps and, if it changes, the name of the
    stage. If stderr is not a terminal, the function prints a line at most once a second.
    """
    begin = last = time.perf_counter()
    first = begin, total
    with CONSOLE.status(title) as status:

        def report(done: int, title: str = title) -> None:
            nonlocal first, last
            now = time.perf_counter()
            # Programs are compiled before the first step of a stage.
            first = first if done > first[1] else (now, done)
            remaining = (now - first[0]) / max(done - first[1], 1) * (total - done)
            line = f"{title}: {done} of {total}" + (
                f", {remaining:.0f} s left" if done > first[1] else ""
            )
            status.update(line)
            if not CONSOLE.is_terminal and (done == total or now > last + 1):
                last = now
                note(line)

        yield report
    note(f"{title}: {time.perf_counter() - begin:.1f} s")


def preview(draw: Callable[[int], list]) -> contextlib.AbstractContextManager[None]:
    """Show a small picture when the first compilation starts, if stderr is a terminal with colors.
    If all programs are cached, no preview is needed.

    **Arguments:**

    - `draw`: computes the picture with a given largest number of pixels per side, as an even number
      of rows of red, green and blue up to 255.
    """
    return sj.cache.watched_compiling(functools.cache(lambda: _show(draw)))


def _show(draw: Callable[[int], list]) -> None:
    note("compiling; later runs reuse the programs")
    if (
        CONSOLE.quiet
        or CONSOLE.no_color
        or CONSOLE.color_system not in ("256", "truecolor")
        or not CONSOLE.encoding.startswith("utf")
        or not CONSOLE.file.isatty()
    ):
        return
    note("a preview without scattering, shadows and gloss, meanwhile:")
    side = min(64, CONSOLE.width, 2 * CONSOLE.height - 8)  # one character shows two pixels
    with contextlib.suppress(Exception):  # a preview must never end the picture
        colors = [[f"rgb({red},{green},{blue})" for red, green, blue in row] for row in draw(side)]
        for above, below in zip(colors[::2], colors[1::2], strict=True):
            CONSOLE.print("".join(f"[{a} on {b}]▀[/]" for a, b in zip(above, below, strict=True)))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows on stdout with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join(cells).rstrip())


# Environment variables of launchers with the number of processes; the first that is set is used.
_DIGEST = re.compile(r"\b([0-9a-f]{8})[0-9a-f]{24,}\b")  # shortened in errors
_COUNTS = "JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"


def complete(
    process: tuple[int, int],
    record_path: Path,
    record: Mapping[str, Any],
    items: Sequence[tuple[Path, ...]],
    prepare: Callable[[], Callable[[int], None]],
    *,
    name: str,
    what: str,
) -> Sequence[int]:
    """Make this process's share of the missing items. All processes first agree on which items are
    missing.

    **Arguments:**

    - `process`: result of `process_index_and_count`, which must precede any computation.
    - `record_path`: path of the record, in the folder of the files.
    - `record`: the settings that the files depend on.
    - `items`: the files of each item.
    - `prepare`: called if an item is missing; returns the function that makes item i.
    - `name`: name of the items, for messages.
    - `what`: description of the work, for messages.

    **Returns:** all items, or those of this process if other processes are still working.

    **Raises:** `ValueError` if the folder contains files made with other settings.
    """
    _check_record(record_path, record, items)
    missing, folder = _missing(items), record_path.parent
    if len(missing) < len(items):
        note(f"{len(items) - len(missing)} of {len(items)} {name} already exist and are kept")
    index, processes = process
    share = missing[index::processes]
    if share:
        make = prepare()
        folder.mkdir(exist_ok=True)
        sj.io.write_record(record_path, record)
        try:
            with stage(what, len(share)) as report:
                for number, i in enumerate(share, 1):
                    make(i)
                    report(number)
        except (KeyboardInterrupt, OSError):
            note(f"finished {name} in {folder} are kept; run the same command again to continue")
            raise
    pending = _missing(items)
    if pending and folder.exists():
        note(
            f"other processes are still computing {len(pending)} {name}; the last process joins "
            "all, or run the same command again"
        )
    return share if pending else range(len(items))


def _missing(items: Sequence[tuple[Path, ...]]) -> list[int]:
    return [i for i, files in enumerate(items) if not all(file.exists() for file in files)]


def _check_record(path: Path, record: Mapping[str, Any], items: Sequence[tuple[Path, ...]]) -> None:
    remedy = "give another --output, or delete that folder"
    files = [file for item in items for file in item if file.exists()]
    if files and not path.exists():
        raise ValueError(f"{files[0]}: has no record of its settings; {remedy}")
    before = sj.io.read_record(path) if path.exists() else record
    changes = [
        f"{name} is {_shown(record.get(name))}, but was {_shown(before.get(name))}"
        for name in sorted(before.keys() | record.keys())
        if before.get(name) != record.get(name)
    ]
    if changes:
        raise ValueError(f"{path}: the settings changed: {'; '.join(changes)}; {remedy}")


def _shown(value: Any) -> str:
    return _DIGEST.sub(r"\1", str(value))


def process_index_and_count() -> tuple[int, int]:
    """Wait for all processes of a launcher, and return the index of this process and the number of
    processes.

    JAX detects SLURM and Open MPI; for other launchers, `JAX_COORDINATOR_ADDRESS`,
    `JAX_NUM_PROCESSES` and `JAX_PROCESS_ID` specify the processes. Afterwards each process
    continues alone, so a failure of one does not stop the others. Call this function before any
    computation.

    **Raises:** `ValueError` if the environment specifies several processes but not the index of
    this process.
    """
    counts = [os.environ[name] for name in _COUNTS if name in os.environ]
    if not counts or counts[0] in ("0", "1"):
        return 0, 1
    try:
        jax.distributed.initialize(
            num_processes=_number("JAX_NUM_PROCESSES"), process_id=_number("JAX_PROCESS_ID")
        )
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"several processes were started, but their settings are incomplete: {error} Set "
            "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID, or "
            "JAX_NUM_PROCESSES=1 for a single process"
        ) from None
    place = jax.process_index(), jax.process_count()
    jax.distributed.shutdown()
    clear_backends()
    return place


def _number(variable: str) -> int | None:
    """Return the number in an environment variable, or `None` if it is not set."""
    return int(os.environ[variable]) if variable in os.environ else None
