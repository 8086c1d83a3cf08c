"""What only a program may decide, never a library: where compiled code is kept, and which device computes."""

import contextlib
import os
from pathlib import Path

import jax


def prepare_jax() -> None:
    """Keep compiled code in the user's cache folder, and compute on the CPU, unless the environment says otherwise.

    `JAX_COMPILATION_CACHE_DIR` and `JAX_PLATFORMS` have the last word; `XDG_CACHE_HOME` moves the cache folder.
    """
    if _unset("jax_platforms"):
        jax.config.update("jax_platforms", "cpu")
    if _unset("jax_compilation_cache_dir"):
        folder = cache_folder()
        with contextlib.suppress(OSError):  # without a place to write to, everything is compiled anew
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))


def _unset(setting: str) -> bool:
    return getattr(jax.config, setting) is None


def cache_folder() -> Path:
    """Give the folder for compiled code; a relative `XDG_CACHE_HOME` is to be ignored."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "splatjax" / "jax"
