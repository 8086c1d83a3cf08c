"""Which share of the work is this process's, where a cluster's launcher has started several."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import jax
from jax.extend.backend import clear_backends

Item = TypeVar("Item")

_STARTED = "JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"


@dataclass(frozen=True)
class Share:
    """One process of several."""

    index: int = 0
    count: int = 1

    def of(self, items: Sequence[Item]) -> list[Item]:
        """Give this process's items: every process has as many, or one less."""
        return list(items[self.index :: self.count])


def own_share() -> Share:
    """Wait until all processes have come this far, and find which of them this is.

    JAX finds out under SLURM and Open MPI; elsewhere `JAX_COORDINATOR_ADDRESS`, `JAX_NUM_PROCESSES`
    and `JAX_PROCESS_ID` say so. From then on each goes on alone: one that fails stops no other. To
    be called before anything is computed.

    **Raises:** `ValueError` when the environment speaks of several processes, and does not say
    which.
    """
    said = {name: number for name in _STARTED if (number := _number(name)) is not None}
    for name, number in said.items():  # the first counts
        if number < 1:
            raise ValueError(f"{name} is {number}; at least one process works")
        if number == 1:
            return Share()
        break
    else:
        return Share()
    try:
        jax.distributed.initialize(
            num_processes=_number("JAX_NUM_PROCESSES"), process_id=_number("JAX_PROCESS_ID")
        )
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"several processes were started, but not all is said of them: {error} Set "
            "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES"
            " and JAX_PROCESS_ID, or JAX_NUM_PROCESSES=1 for a process of its own"
        ) from None
    share = Share(jax.process_index(), jax.process_count())
    jax.distributed.shutdown()
    clear_backends()
    return share


def _number(name: str) -> int | None:
    found = os.environ.get(name)
    if found is None:
        return None
    if not found.isdecimal():
        raise ValueError(f"{name} is {found!r}; it must be a whole number")
    return int(found)
