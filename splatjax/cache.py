"""What takes long at the start of a program, kept for the next start in a folder of the user's own:
the bust, plans, and compiled pictures.

    import splatjax as sj
    sj.cache.keep()

Nothing is kept before this call. An entry is used again only where everything that it depends on is
the same: its inputs, the source of splatjax, the versions of JAX and others, JAX's settings, and
the processor. Entries are pickled: the folder must belong to the user, and nobody else may write to
it. What is damaged or foreign there is ignored and replaced.
"""

import functools
import hashlib
import os
import pickle
import platform
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jaxlib
import numpy as np
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jax.tree_util import PyTreeDef

Function = TypeVar("Function", bound=Callable)

_LARGEST = 1 << 30  # bytes in the folder, beyond which what was not used for longest is deleted
_DIGEST = 32  # bytes
_LEAST_TIME = "jax_persistent_cache_min_compile_time_secs"
# JAX's settings, unless its environment variables decide otherwise.
_SETTINGS = {
    # Planning runs many small programs, each compiled in a moment and together in seconds.
    _LEAST_TIME: 0.0,
    # XLA logs an error of 4,000 characters for each program that it takes from the cache and runs
    # (JAX issue 38445).
    "jax_logging_level": "CRITICAL",
}
_EFFECTLESS = re.compile("cache|log|platform")  # settings of JAX that no result depends on
_folder: Path | None = None
_programs: dict[str, Callable] = {}


def keep(folder: str | os.PathLike[str] | None = None) -> Path:
    r"""Keep what takes long at the start of a program, and take it from there where it is.

    `splatjax.bust`, `splatjax.make_plan`, `splatjax.illuminate` and `splatjax.render` on one
    device, called outside `jit` and `grad`, are then quick from the second start on. What JAX
    compiles itself, gradients among it, is kept in its compilation cache in the same folder. To be
    called once, before anything is computed.

    It sets `jax_compilation_cache_dir`, unless it is set, `jax_persistent_cache_min_compile_time`
    and `jax_logging_level`, unless environment variables set them. `JAX_ENABLE_COMPILATION_CACHE=0`
    keeps nothing.

    **Arguments:**

    - `folder`: made where it is missing. By default that of the command line: `splatjax/jax` in
      the absolute path `XDG_CACHE_HOME`, or in `~/.cache`. It may be deleted at any time; besides
      JAX's own files it takes 1 GB at most.

    **Returns:** the folder in it for this kind of processor.

    **Raises:** `OSError` when it cannot be made; `PermissionError` when it belongs to another user,
    or others may write to it.
    """
    global _folder
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = base if base.is_absolute() else Path.home() / ".cache"
    whole = Path(folder or base / "splatjax" / "jax") / _processor()
    kept_folder = whole / "kept"
    kept_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_private(kept_folder):
        raise PermissionError(f"{kept_folder}: others may write to it; delete it")
    if jax.config.jax_compilation_cache_dir is None:  # ty: ignore[missing-attribute]
        jax.config.update("jax_compilation_cache_dir", str(whole))
    for name, value in _SETTINGS.items():
        if name.upper() not in os.environ:
            jax.config.update(name, value)
    _source()  # now: files may change while the program runs
    _folder = kept_folder
    return whole


def _processor() -> str:
    """Return a name for the kind of processor: home folders are shared by machines, and JAX keeps
    the code of all under one name.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    digest = hashlib.sha256((flags or [platform.processor()])[0].encode()).hexdigest()[:12]
    return f"{platform.machine()}-{digest}"


def kept(function: Function) -> Function:
    """Let `keep` keep the results of a function of arrays and numbers, by all that they hold."""

    @functools.wraps(function)
    def called(*arguments, **named):
        name = _name(function, (arguments, named), by_contents=True)
        if name is None:
            return function(*arguments, **named)
        result = _read(name)
        if result is None:
            result = jax.tree.map(np.asarray, function(*arguments, **named))
            _write(name, result)
        return jax.device_put(result)  # compiles nothing, unlike jnp.asarray

    return cast("Function", called)


def kept_jit(function: Function) -> Function:
    """Compile a function, as `eqx.filter_jit` does, and let `keep` keep its programs; they are
    found by the structure and shapes of the arguments, without tracing.
    """
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def called(*arguments):
        name = _name(function, arguments, by_contents=False)
        if name is None:
            return compiled(*arguments)
        leaves = jax.tree.leaves(arguments)
        if name not in _programs:
            with suppress(Exception):  # whatever is wrong with a file, it is made again
                program = _loaded(_read(name), leaves)
                result = jax.block_until_ready(program(leaves))
                _programs[name] = program
                return result
            _programs[name] = _compiled(name, function, arguments)
        return _programs[name](leaves)

    return cast("Function", called)


def _loaded(content: tuple[bytes, Any], leaves: list[jax.Array]) -> Callable:
    program, result = content
    structures = jax.tree.structure(((leaves,), {})), jax.tree.structure(result)
    devices = list(leaves[0].devices())
    return deserialize_and_load(program, *structures, devices[0].client, devices)


def _compiled(name: str, function: Callable, arguments: Any) -> Callable:
    leaves, structure = jax.tree.flatten(arguments)

    # A list of arrays: JAX cannot make records of what it puts into the arguments of what it loads.
    def of_leaves(leaves):
        return function(*jax.tree.unflatten(structure, leaves))

    before = jax.config.jax_persistent_cache_min_compile_time_secs  # ty: ignore[missing-attribute]
    try:
        # Not in JAX's cache as well: what is taken from there and kept once more lacks kernels.
        jax.config.update(_LEAST_TIME, float("inf"))
        program = jax.jit(of_leaves).lower(leaves).compile()
    finally:
        jax.config.update(_LEAST_TIME, before)
    with suppress(Exception):  # not every program can be kept
        content, _, returned = serialize(program)
        _write(name, (content, jax.tree.unflatten(returned, range(returned.num_leaves))))
    return program


def _name(function: Callable, arguments: Any, *, by_contents: bool) -> str | None:
    """Return the name of the file for what a function makes of its arguments; `None` for what is
    not kept: nothing before `keep`; nothing under `jit`, `grad` or `vmap`, on several devices, or
    that code outside splatjax has a part in.
    """
    if _folder is None or not jax.config.jax_enable_compilation_cache:  # ty: ignore[missing-attribute]
        return None
    leaves, structure = jax.tree.flatten(arguments)
    arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    if any(isinstance(array, Tracer) for array in arrays):
        return None
    devices = {device for array in arrays for device in array.devices()}
    kinds = [f"{kind.__module__}.{kind.__qualname__}" for kind in _kinds(structure)]
    numbers = [leaf for leaf in leaves if type(leaf) in (bool, int, float)]
    is_own = all(kind.startswith(("builtins.", "splatjax.")) for kind in kinds)
    # Objects and functions among the static fields show their address, or nothing of their code.
    if (
        len(devices) > 1
        or not is_own
        or "<" in str(structure)
        or len(arrays) + len(numbers) < len(leaves)
        or (numbers and not by_contents)
    ):
        return None
    unique = {id(array): array for array in arrays if by_contents}
    contents = {key: hashlib.blake2b(np.asarray(unique[key]).tobytes()).digest() for key in unique}
    depends_on = (
        f"{function.__module__}.{function.__qualname__}",
        kinds,
        structure,
        numbers,
        [(array.aval, contents.get(id(array))) for array in arrays],
        [(device, device.device_kind, device.client.platform_version) for device in devices],
        sorted(item for item in jax.config.values.items() if not _EFFECTLESS.search(item[0])),
        os.environ.get("XLA_FLAGS"),
        [module.__version__ for module in (jax, jaxlib, np, eqx)],
        platform.python_version(),
        _source(),
    )
    return f"{function.__name__.strip('_')}-{hashlib.sha256(repr(depends_on).encode()).hexdigest()}"


def _kinds(structure: PyTreeDef) -> Iterator[type]:
    """Iterate over the classes of the nodes of a tree."""
    data = structure.node_data()
    if data is not None:
        yield data[0]
        for child in structure.children():
            yield from _kinds(child)


@functools.cache
def _source() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _is_private(path: Path) -> bool:
    """Return whether a file or folder belongs to the user, and nobody else may write to it."""
    status = path.stat()
    return hasattr(os, "getuid") and status.st_uid == os.getuid() and not status.st_mode & 0o022


def _read(name: str) -> Any:
    """Read what `_write` wrote under a name; `None` where there is no such file, or a damaged one,
    or one of another name.
    """
    path = cast("Path", _folder) / name
    with suppress(Exception):
        if _is_private(path):
            content = path.read_bytes()
            if content[:_DIGEST] == _digest(name, content[_DIGEST:]):
                os.utime(path)
                return pickle.loads(content[_DIGEST:])
    return None


def _write(name: str, content: Any) -> None:
    """Write a file, whole or not at all; delete what was not used for longest."""
    folder = cast("Path", _folder)
    with suppress(Exception):  # without it, it is made again at the next start
        packed = pickle.dumps(content)
        if len(packed) > _LARGEST // 4:
            return
        handle, temporary = tempfile.mkstemp(dir=folder)
        try:
            with open(handle, "wb") as file:
                file.write(_digest(name, packed) + packed)
            os.replace(temporary, folder / name)
        finally:
            Path(temporary).unlink(missing_ok=True)
        total = 0
        for path in sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True):
            total += path.stat().st_size
            if total > _LARGEST:
                path.unlink(missing_ok=True)


def _digest(name: str, packed: bytes) -> bytes:
    return hashlib.blake2b(name.encode() + packed, digest_size=_DIGEST).digest()
