"""Free memory, compared with the memory that a computation requires before it begins."""

import math
import os
from pathlib import Path


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
    try:
        import resource  # not on Windows
    except ImportError:
        return math.inf
    page = os.sysconf("SC_PAGE_SIZE")
    free = float(page * os.sysconf("SC_PHYS_PAGES"))
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * page
    except OSError:  # not on Linux
        return free
    available = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    free = min(free, *(1024.0 * int(kilobytes) for kilobytes in available))
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit == resource.RLIM_INFINITY else max(min(free, limit - taken), 0.0)
