"""Whether something fits into memory, asked before it is begun."""

import math
import os
from pathlib import Path


def check_room(what: str, needed: float, remedy: str) -> None:
    """Refuse what does not fit.

    **Arguments:**

    - `what`: is to be held in memory.
    - `needed`: bytes, about.
    - `remedy`: what to do about it.

    **Raises:** `ValueError` when less than that is free.
    """
    free = free_bytes()
    if needed > free:
        raise ValueError(
            f"{what} would take about {needed / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are "
            f"free; {remedy}"
        )


def free_bytes() -> float:
    """Give how much memory this process may still take: what the machine has free, within the limit
    of its address space.
    """
    try:
        import resource  # not on Windows
    except ImportError:
        return math.inf
    free = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf(
            "SC_PAGE_SIZE"
        )
    except OSError:  # not on Linux
        return free
    free = min(
        free, *(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    )
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit == resource.RLIM_INFINITY else max(min(free, limit - taken), 0.0)
