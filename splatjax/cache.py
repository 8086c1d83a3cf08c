"""A cache on disk of expensive results, for the next start of a program: the bust, plans and
compiled programs.

    import splatjax as sj

    sj.cache.keep()

Nothing is cached before this call. A file is used only if everything that it depends on is
unchanged: inputs, the source of splatjax, the versions of JAX and other packages, JAX's settings,
and the processor. Files are pickled, so the folder must belong to the user, and nobody else may
write to it. Damaged or foreign files are ignored and replaced.
"""

import functools
import hashlib
import os
import pickle
import platform
import re
import tempfile
import threading
from collections.abc import Callable, Generator, Hashable, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jax.tree_util import PyTreeDef

from splatjax._library import profiles_folder
from splatjax._precision import Function, full_precision

_LARGEST = 1 << 30  # bytes in the folder, beyond which the least recently used files are deleted
_EFFECTLESS = re.compile("cache|log|platform")  # settings of JAX that do not change results
# Events that JAX records when its cache lacks a small program, and this module before it compiles a
# picture.
_COMPILING = "/jax/compilation_cache/cache_misses", "/splatjax/cache/compiling"
_LEAST_TIME = "jax_persistent_cache_min_compile_time_secs"
# Settings of JAX, unless environment variables set them.
_SETTINGS = {
    # Planning runs many small programs that together take seconds to compile.
    _LEAST_TIME: 0.0,
    # XLA logs an error of 4,000 characters for each program that it takes from the cache and runs
    # (JAX issue 38445).
    "jax_logging_level": "CRITICAL",
}
_folder: Path | None = None
_compiler_options: dict[str, bool | str] = {}
_programs: dict[Path, Callable] = {}
_capacities: dict[Hashable, list[int]] = {}
_exclusive = threading.RLock()  # while settings of JAX are changed


@contextmanager
def watched_compiling(report: Callable[[], object]) -> Generator[None]:
    """Call `report` whenever the current thread begins to compile a program."""
    thread = threading.current_thread()

    def listen(event: str, **_: Any) -> None:
        if event in _COMPILING and threading.current_thread() is thread:
            report()

    jax.monitoring.register_event_listener(listen)
    try:
        yield
    finally:
        jax.monitoring.unregister_event_listener(listen)


def keep(
    folder: str | os.PathLike[str] | None = None,
    compiler_options: Mapping[str, bool | str] = MappingProxyType({}),
) -> Path:
    r"""Enable the cache: store expensive results, and read them at the next start.

    Call it once, before any computation. From the second start on, `splatjax.bust`,
    `splatjax.make_plan`, `splatjax.render` and the other functions of pictures and light are fast
    when they are called on one device, outside `jit`, `grad` and `vmap`. JAX's own compilation
    cache, in the same folder, stores other programs such as gradients.

    It sets `jax_compilation_cache_dir` if it is not set, and
    `jax_persistent_cache_min_compile_time_secs` and `jax_logging_level` unless environment
    variables set them. With `JAX_ENABLE_COMPILATION_CACHE=0`, nothing is cached.

    **Arguments:**

    - `folder`: created if missing; by default `splatjax/jax` in the absolute path `XDG_CACHE_HOME`
      or in `~/.cache`, which the command line uses too. It may be deleted at any time. It takes at
      most 1 GB besides JAX's own files.
    - `compiler_options`: options of XLA for the programs of pictures; if XLA lacks one of them, all
      are dropped. With `{"xla_cpu_use_fusion_emitters": False}` programs compile in three quarters
      of the time and run a tenth slower.

    **Returns:** the subfolder for this kind of processor.

    **Raises:** `OSError` if the folder cannot be created; `PermissionError` if its subfolder `kept`
    belongs to another user or others may write to it. Then only JAX's cache is used.
    """
    global _folder, _compiler_options
    for name, value in _SETTINGS.items():
        if name.upper() not in os.environ:
            jax.config.update(name, value)
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    base = base if base.is_absolute() else Path.home() / ".cache"
    cache_folder = Path(folder or base / "splatjax" / "jax").absolute() / _processor()
    kept_folder = cache_folder / "kept"
    kept_folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if jax.config.jax_compilation_cache_dir is None:  # ty: ignore[missing-attribute]
        jax.config.update("jax_compilation_cache_dir", str(cache_folder))
    if not _is_private(kept_folder):  # or the owner is unknown
        raise PermissionError(f"{kept_folder}: other users may write to this folder; delete it")
    _source()  # read now, since files may change while the program runs
    _folder, _compiler_options = kept_folder, dict(compiler_options)
    _remember(_read(_capacities_path()) or {})
    return cache_folder


def reuse_capacity(kind: Hashable, least: int, capacity: int, most: float = 1.25) -> int:
    """Return a capacity for arrays of a kind, preferably one for which programs are already
    compiled.

    Among the capacities that were planned before, by this process or by earlier ones with the same
    cache, it is the smallest from `least` up to `most` times `capacity`. If there is none,
    `capacity` is remembered and returned.

    With several processes nothing is remembered, because all must run the same programs.
    """
    if jax.process_count() > 1:
        return capacity
    planned = _capacities.setdefault(kind, [])
    serving = [size for size in planned if least <= size <= most * capacity]
    if not serving:
        planned.append(capacity)
    return min(serving, default=capacity)


def _remember(capacities: dict[Hashable, list[int]]) -> None:
    for kind, sizes in capacities.items():
        _capacities[kind] = sorted({*_capacities.get(kind, ()), *sizes})


def _capacities_path() -> Path:
    assert _folder is not None
    return _folder / f"capacities-{_digest(_source(), *_versions()).hex()}"


def kept(function: Function) -> Function:
    """Cache the results of a function of arrays and numbers, by the values of its arguments."""

    @functools.wraps(function)
    def called(*arguments, **named):
        path = _path(function, (arguments, named), by_values=True)
        if path is None:
            return function(*arguments, **named)
        result = _read(path)
        if result is None:
            known = sum(map(len, _capacities.values()))
            result = _write(path, jax.device_get(function(*arguments, **named)))
            if sum(map(len, _capacities.values())) > known:
                _remember(_read(_capacities_path()) or {})  # of other processes
                _write(_capacities_path(), _capacities)
        return jax.device_put(result)  # compiles nothing, unlike jnp.asarray

    return cast("Function", called)


def kept_jit(function: Function) -> Function:
    """Compile a function of arrays, like `eqx.filter_jit`, and cache its programs by the structure
    and the shapes of the arguments, so that a cached program needs no tracing. Numbers are static.
    """
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    @full_precision
    def called(*arguments):
        path = _path(function, arguments, by_values=False)
        if path is None:
            return compiled(*arguments)
        leaves = jax.tree.leaves(eqx.filter(arguments, eqx.is_array))
        if path not in _programs:
            with suppress(Exception):  # a damaged file is replaced
                content, returned, calls_lapack = _read(path)
                if calls_lapack:  # JAX loads it when it first lowers a call
                    jax.jit(jnp.linalg.cholesky).lower(jnp.eye(1))
                structures = jax.tree.structure(((leaves,), {})), jax.tree.structure(returned)
                devices = list(leaves[0].devices())
                program = deserialize_and_load(content, *structures, devices[0].client, devices)
                result = jax.block_until_ready(program(leaves))
                _programs[path] = program
                return result
            _programs[path] = _compiled(path, function, arguments)
        return _programs[path](leaves)

    return cast("Function", called)


def _compiled(path: Path, function: Callable, arguments: tuple) -> Callable:
    arrays, static = eqx.partition(arguments, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    jax.monitoring.record_event(_COMPILING[1])

    # The program takes a list of arrays, because a loaded program cannot make records.
    def of_leaves(leaves):
        return function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))

    with _exclusive, ExitStack() as stack:
        # JAX's cache is off here: an executable that is read from it lacks kernels when serialized.
        stack.callback(jax.config.update, _LEAST_TIME, jax.config.values[_LEAST_TIME])
        jax.config.update(_LEAST_TIME, float("inf"))
        lowered = jax.jit(of_leaves).lower(leaves)
        try:
            program = lowered.compile(_compiler_options)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            program = lowered.compile()
    with suppress(Exception):  # not every program can be serialized
        content, _, returned = serialize(program)
        returned = jax.tree.unflatten(returned, range(returned.num_leaves))
        _write(path, (content, returned, "lapack" in (program.as_text() or "")))
    return program


def _path(function: Any, arguments: Any, *, by_values: bool) -> Path | None:
    """Return the path of the file for a function and its arguments. It is `None` where nothing is
    cached: before `keep`, while JAX traces, on several devices, and with classes from outside
    splatjax.
    """
    leaves, structure = jax.tree.flatten(arguments)
    arrays = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    numbers = [None if isinstance(leaf, jax.Array) else leaf for leaf in leaves]
    if (
        _folder is None
        or not jax.config.jax_enable_compilation_cache  # ty: ignore[missing-attribute]
        or not {type(number) for number in numbers} <= {NoneType, bool, int, float}
        or any(isinstance(array, Tracer) for array in arrays)
        or len(devices := {device for array in arrays for device in array.devices()}) > 1
        or not all(kind.startswith(("builtins.", "splatjax.")) for kind in _kinds(structure))
        or "<" in str(structure)  # a static function or object, which its repr does not identify
    ):
        return None
    different = {id(array): array for array in arrays if by_values}
    values = {key: _digest(jax.device_get(array).tobytes()) for key, array in different.items()}
    depends_on = (
        f"{function.__module__}.{function.__name__}",
        (structure, _kinds(structure), numbers),
        [(array.aval, values.get(id(array))) for array in arrays],
        [(device, device.device_kind, device.client.platform_version) for device in devices],
        sorted(item for item in jax.config.values.items() if not _EFFECTLESS.search(item[0])),
        (os.environ.get("XLA_FLAGS"), by_values or sorted(_compiler_options.items())),
        (platform.python_version(), _processor(), _source()),
        _versions(),
    )
    return _folder / f"{function.__name__}-{_digest(repr(depends_on).encode()).hex()}".strip("_")


def _kinds(structure: PyTreeDef) -> list[str]:
    """Return the classes of the nodes of a tree."""
    node = structure.node_data()
    kinds = [] if node is None else [f"{node[0].__module__}.{node[0].__qualname__}"]
    return kinds + [kind for child in structure.children() for kind in _kinds(child)]


@functools.cache
def _processor() -> str:
    """Return a name for the kind of processor. Machines may share home folders, and JAX does not
    distinguish their code.
    """
    path = Path("/proc/cpuinfo")
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    flags = re.search("^(flags|Features).*", text, re.MULTILINE)
    digest = hashlib.sha256((flags[0] if flags else platform.processor()).encode()).hexdigest()
    return f"{platform.machine()}-{digest[:12]}"


@functools.cache
def _source() -> bytes:
    """Compute a digest of the modules of splatjax and of the data that they read."""
    files = *Path(__file__).parent.rglob("*.py"), *profiles_folder().glob("*.npz")
    return _digest(*(path.read_bytes() for path in sorted(files)))


def _versions() -> list[bytes]:
    return [module.__version__.encode() for module in (jax, jaxlib, eqx)]


def _digest(*contents: bytes) -> bytes:
    return hashlib.sha256(b"".join(contents)).digest()


def _is_private(path: Path) -> bool:
    """Return whether a file or folder belongs to the user and nobody else may write to it."""
    status = path.stat()
    return hasattr(os, "getuid") and status.st_uid == os.getuid() and not status.st_mode & 0o022


def _read(path: Path) -> Any:
    """Read a file of `_write`; return `None` if it is missing or damaged."""
    with suppress(Exception):
        content = path.read_bytes()
        if _is_private(path) and content[:32] == _digest(path.name.encode(), content[32:]):
            os.utime(path)
            return pickle.loads(content[32:])
    return None


def _write(path: Path, content: Any) -> Any:
    """Write a file atomically, delete the least recently used files, and return the content."""
    with suppress(Exception):  # without a file, the next start computes the result again
        packed = pickle.dumps(content)
        if len(packed) > _LARGEST // 4:
            return content
        with suppress(FileNotFoundError), tempfile.NamedTemporaryFile(dir=path.parent) as file:
            file.write(_digest(path.name.encode(), packed) + packed)
            file.flush()
            os.replace(file.name, path)  # the temporary file is gone, so its deletion is skipped
        total = 0
        for entry in sorted(path.parent.iterdir(), key=lambda entry: -entry.stat().st_mtime):
            total += entry.stat().st_size
            if total > _LARGEST:
                entry.unlink(missing_ok=True)
    return content
