"""Checks that a computation fits into the free memory, before it begins."""

import psutil


def check_memory(what: str, required: float, remedy: str, capacity: float | None = None) -> None:
    """Refuse a computation that does not fit into memory.

    **Arguments:**

    - `what`: what needs the memory, the subject of the error.
    - `required`: approximate number of bytes.
    - `remedy`: the end of the error.
    - `capacity`: bytes; by default the free memory of this machine.

    **Raises:** `ValueError` when `capacity` is less than `required`.
    """
    capacity = free_bytes() if capacity is None else capacity
    if required > capacity:
        raise ValueError(
            f"{what} would take about {required / 1e9:.3g} GB of memory, and "
            f"{capacity / 1e9:.3g} GB are free; {remedy}"
        )


def free_bytes() -> float:
    """Read how many bytes this process may still allocate: the free memory of the machine, or less
    if the address space is limited.
    """
    free = float(psutil.virtual_memory().available)
    if hasattr(psutil, "RLIMIT_AS"):  # not on Windows and macOS
        process = psutil.Process()
        limit = process.rlimit(psutil.RLIMIT_AS)[0]
        if limit != psutil.RLIM_INFINITY:
            free = min(free, limit - process.memory_info().vms)
    return max(free, 0.0)
