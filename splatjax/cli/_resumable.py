"""Long commands that write many files: several processes share them, and after an interruption the
same command continues.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from jax.extend.backend import clear_backends

from splatjax.io import read_record, write_record

from ._terminal import note, stage

# Variables that hold how many processes a launcher has started; the first that is set counts.
_COUNTS = "JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"


def complete(
    record_path: Path,
    record: Mapping[str, Any],
    items: Sequence[tuple[Path, ...]],
    prepare: Callable[[], Callable[[int], None]],
    *,
    name: str,
    what: str,
) -> Sequence[int]:
    """Make the missing items that are this process's. All processes wait until each has seen the
    same ones missing.

    **Arguments:**

    - `record_path`: of the record, in the folder of the files.
    - `record`: what the files depend on.
    - `items`: the files of each item.
    - `prepare`: called where an item is missing; returns the function that makes item i.
    - `name`: of the items, in messages.
    - `what`: is done, for the message.

    **Returns:** all items; where other processes are still at work, those of this one.

    **Raises:** `ValueError` when the folder holds files that are made of something else.
    """
    _check_record(record_path, record, items)
    missing, folder = _missing(items), record_path.parent
    if len(missing) < len(items):
        note(f"{len(items) - len(missing)} of {len(items)} {name} are there already, and are kept")
    index, processes = process_index_and_count()
    own = missing[index::processes]
    if own:
        make = prepare()
        folder.mkdir(exist_ok=True)
        write_record(record_path, record)
        try:
            with stage(what, len(own)) as report:
                for number, i in enumerate(own, 1):
                    make(i)
                    report(number)
        except (KeyboardInterrupt, OSError):
            note(f"the {name} in {folder} are whole; run the same command again to continue")
            raise
    left = _missing(items)
    if left and folder.exists():
        note(
            f"other processes are still at work on {len(left)} {name}; the last of them joins all, "
            "or the same command does when it is run again"
        )
    return own if left else range(len(items))


def _missing(items: Sequence[tuple[Path, ...]]) -> list[int]:
    return [i for i, files in enumerate(items) if not all(file.exists() for file in files)]


def _check_record(path: Path, record: Mapping[str, Any], items: Sequence[tuple[Path, ...]]) -> None:
    remedy = "name another --output, or delete that folder"
    if not path.exists():
        files = [file for item in items for file in item if file.exists()]
        if files:
            raise ValueError(f"{files[0]}: has no record of what it is made of; {remedy}")
        return
    before = read_record(path)
    changes = [
        f"{name} is {record.get(name)}, but was {before.get(name)}"
        for name in sorted(before.keys() | record.keys())
        if before.get(name) != record.get(name)
    ]
    if changes:
        raise ValueError(f"{path}: the files beside it differ: {'; '.join(changes)}; {remedy}")


def process_index_and_count() -> tuple[int, int]:
    """Wait until all processes of a launcher have come this far; return which of how many this is.

    JAX finds out under SLURM and Open MPI; elsewhere `JAX_COORDINATOR_ADDRESS`, `JAX_NUM_PROCESSES`
    and `JAX_PROCESS_ID` give it. From then on each goes on alone: one that fails stops no other. To
    be called before anything is computed.

    **Raises:** `ValueError` when the environment names several processes, and not which this is.
    """
    counts = [os.environ[name] for name in _COUNTS if name in os.environ]
    if not counts or counts[0] in ("0", "1"):
        return 0, 1
    names = {"num_processes": "JAX_NUM_PROCESSES", "process_id": "JAX_PROCESS_ID"}
    given = {key: os.environ[name] for key, name in names.items() if name in os.environ}
    try:
        numbers: dict[str, Any] = {key: int(number) for key, number in given.items()}
        jax.distributed.initialize(**numbers)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"several processes were started, but not all of them is known: {error} Set "
            "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES"
            " and JAX_PROCESS_ID, or JAX_NUM_PROCESSES=1 for a process of its own"
        ) from None
    place = jax.process_index(), jax.process_count()
    jax.distributed.shutdown()
    clear_backends()
    return place
