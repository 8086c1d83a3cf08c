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
    try:
        import resource  # not on Windows
    except ImportError:
        return free
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return free
    return max(min(free, limit - psutil.Process().memory_info().vms), 0.0)
