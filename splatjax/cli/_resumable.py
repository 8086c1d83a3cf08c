"""Long commands that write many files: several processes share them, and after an interruption the
same command continues.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from jax.extend.backend import clear_backends

from splatjax.io import read_record, write_record

from ._report import note

# Variables that hold how many processes a launcher has started; the first that is set counts.
_COUNTS = "JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"


@dataclass(frozen=True)
class ResumableFolder:
    """The files of a command, and beside them a record of what they are made of.

    **Attributes:**

    - `record_path`: of the record, in the folder of the files.
    - `record`: what the files depend on.
    - `items`: the files of each item.
    - `what`: the items, as a message calls them.
    """

    record_path: Path
    record: Mapping[str, Any]
    items: Sequence[tuple[Path, ...]]
    what: str

    def check(self) -> None:
        """Raise `ValueError` when the folder holds files that are made of something else."""
        path, remedy = self.record_path, "name another --output, or delete that folder"
        if not path.exists():
            files = [file for item in self.items for file in item if file.exists()]
            if files:
                raise ValueError(f"{files[0]}: has no record of what it is made of; {remedy}")
            return
        old, new = read_record(path), self.record
        changes = [
            f"{name} is {new.get(name)}, but was {old.get(name)}"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name)
        ]
        if changes:
            raise ValueError(f"{path}: the files beside it differ: {'; '.join(changes)}; {remedy}")

    def missing(self) -> list[int]:
        """Return the items that have yet to be made."""
        return [i for i, item in enumerate(self.items) if not all(file.exists() for file in item)]

    def own_missing(self) -> list[int]:
        """Return the missing items that are this process's to make. All processes wait here until
        each has seen the same ones missing.
        """
        missing, count = self.missing(), len(self.items)
        if len(missing) < count:
            note(f"{count - len(missing)} of {count} {self.what} are there already, and are kept")
        index, processes = process_index_and_count()
        return missing[index::processes]

    def begin(self) -> None:
        """Make the folder, and write the record."""
        self.record_path.parent.mkdir(exist_ok=True)
        write_record(self.record_path, self.record)

    def is_complete(self) -> bool:
        """Return whether all items are there; if not, other processes are still at work."""
        if missing := self.missing():
            note(
                f"other processes are still at work on {len(missing)} {self.what}; the last of "
                "them joins all, or the same command does when it is run again"
            )
        return not missing


def process_index_and_count() -> tuple[int, int]:
    """Wait until all processes of a launcher have come this far; return which of how many this is.

    JAX finds out under SLURM and Open MPI; elsewhere `JAX_COORDINATOR_ADDRESS`, `JAX_NUM_PROCESSES`
    and `JAX_PROCESS_ID` give it. From then on each goes on alone: one that fails stops no other. To
    be called before anything is computed.

    **Raises:** `ValueError` when the environment names several processes, and not which this is.
    """
    counts = [count for name in _COUNTS if (count := _number(name, least=1)) is not None]
    if not counts or counts[0] == 1:
        return 0, 1
    try:
        jax.distributed.initialize(
            num_processes=_number("JAX_NUM_PROCESSES", least=1),
            process_id=_number("JAX_PROCESS_ID", least=0),
        )
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


def _number(name: str, least: int) -> int | None:
    given = os.environ.get(name)
    if given is not None and not (given.isdecimal() and int(given) >= least):
        raise ValueError(f"{name} is {given!r}; it must be a whole number, {least} or more")
    return None if given is None else int(given)
