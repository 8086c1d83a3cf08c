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
    says otherwise.

    JAX's own variables, `JAX_COMPILATION_CACHE_DIR`, `JAX_PLATFORMS` and others, have the last
    word; `XDG_CACHE_HOME` moves the cache folder.
    """
    if _unset("jax_platforms"):
        jax.config.update("jax_platforms", "cpu")
    if _unset("jax_compilation_cache_dir"):
        folder = cache_folder()
        with contextlib.suppress(
            OSError
        ):  # without a place to write to, everything is compiled anew
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
    if _unset_by_environment("jax_persistent_cache_min_compile_time_secs"):
        # Planning runs a hundred small programs, each compiled in a moment and together in seconds.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if _unset_by_environment("jax_logging_level"):
        # XLA shouts an error, of 4,000 characters, at each program that it takes from the cache and
        # runs (JAX issue 38445).
        jax.config.update("jax_logging_level", "CRITICAL")


def _unset(setting: str) -> bool:
    return getattr(jax.config, setting) is None


def _unset_by_environment(setting: str) -> bool:
    return setting.upper() not in os.environ


def cache_folder() -> Path:
    """Give the folder for compiled code, one for each kind of processor; a relative
    `XDG_CACHE_HOME` is to be ignored.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (
        (base if base.is_absolute() else Path.home() / ".cache") / "splatjax" / "jax" / _processor()
    )


def _processor() -> str:
    """Name what the processor can do: home folders are shared by machines, and JAX keeps their code
    under one name.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    abilities = next(
        (line for line in lines if line.startswith(("flags", "Features"))), platform.processor()
    )
    return f"{platform.machine()}-{hashlib.sha256(abilities.encode()).hexdigest()[:12]}"
