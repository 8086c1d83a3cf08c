"""Free memory, compared with the memory that a computation requires before it begins."""

import psutil


def check_memory(what: str, required: float, remedy: str, capacity: float | None = None) -> None:
    """Refuse a computation that does not fit into memory.

    **Arguments:**

    - `what`: is held in memory.
    - `required`: bytes, about.
    - `remedy`: completes the sentence.
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
    """Read how much memory this process may still take: the free memory of the machine, within the
    limit of the address space.
    """
    free = float(psutil.virtual_memory().available)
    if hasattr(psutil, "RLIMIT_AS"):  # not on Windows and macOS
        process = psutil.Process()
        limit = process.rlimit(psutil.RLIMIT_AS)[0]
        if limit != psutil.RLIM_INFINITY:
            free = min(free, limit - process.memory_info().vms)
    return max(free, 0.0)
