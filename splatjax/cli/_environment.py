"""What only a program may decide, never a library: where compiled code is kept, and which device
computes.
"""

import contextlib
import hashlib
import os
import platform
from pathlib import Path

import jax


def prepare_jax() -> None:
    """Keep compiled code in the user's cache folder, and compute on the CPU, unless the environment
    decides otherwise.

    JAX's own variables, `JAX_COMPILATION_CACHE_DIR`, `JAX_PLATFORMS` and others, take precedence;
    `XDG_CACHE_HOME` moves the cache folder.
    """
    if jax.config.jax_platforms is None:  # ty: ignore[missing-attribute]
        jax.config.update("jax_platforms", "cpu")
    if jax.config.jax_compilation_cache_dir is None:  # ty: ignore[missing-attribute]
        folder = cache_folder()
        with contextlib.suppress(OSError):  # without it, everything is compiled each time
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
    settings = {
        # Planning runs a hundred small programs, each compiled in a moment and together in seconds.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        # XLA logs an error of 4,000 characters for each program that it takes from the cache and
        # runs (JAX issue 38445).
        "jax_logging_level": "CRITICAL",
    }
    for name, value in settings.items():
        if name.upper() not in os.environ:
            jax.config.update(name, value)


def cache_folder() -> Path:
    """Return the folder for compiled code.

    It is one for each kind of processor: home folders are shared by machines, and JAX keeps the
    code of all under one name. A relative `XDG_CACHE_HOME` is ignored.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = base if base.is_absolute() else Path.home() / ".cache"
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    digest = hashlib.sha256((flags or [platform.processor()])[0].encode()).hexdigest()[:12]
    return base / "splatjax" / "jax" / f"{platform.machine()}-{digest}"
