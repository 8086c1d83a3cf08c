"""Processes in which mutants meet tests; for `mutate.py`.

A worker has the project imported. Into its functions it puts the code of a mutant, forgets what was
compiled, and runs the tests; then it puts back what was there. That takes seconds less than a new
process for each. What is not inside of a function (constants, fields, defaults) is imported, and
meets its tests in a new process.
"""

import functools
import gc
import importlib
import multiprocessing
import os
import pkgutil
import resource
import sys
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FunctionType

_HOOK = ("splatjax",), "beartype.beartype"
_PLAIN = (
    "addopts=--strict-markers --strict-config -p no:cacheprovider"  # the project's, less the hook
)
_FEWER = 100  # mutants to a worker, which grows with each
_PATIENCE = 3600.0  # seconds without an answer


def in_child(
    log: Path, work: Callable[[], int], processor_seconds: float | None = None
) -> tuple[int, float]:
    """Do something in a process of its own; give its exit status, or minus the signal that ended
    it, and its seconds.
    """
    child = os.fork()
    if child == 0:
        if processor_seconds is not None:
            resource.setrlimit(
                resource.RLIMIT_CPU, (round(processor_seconds), round(processor_seconds) + 5)
            )
        _speak_into(log)
        status = 70
        try:
            status = int(work())
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        os._exit(status)
    _, status, used = os.wait4(child, 0)
    return (
        -os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)
    ), used.ru_utime + used.ru_stime


def _speak_into(log: Path) -> None:
    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 1)
    os.dup2(said, 2)


def _configure(folder: Path, double: bool) -> None:
    import jax

    os.chdir(folder)
    sys.path.insert(0, str(folder))
    jax.config.update("jax_enable_x64", double)
    jax.config.update("jax_compilation_cache_dir", str(folder.parent / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.02)


def pytest_in(folder: Path, double: bool, arguments: list[str], plugins=()) -> int:
    """Run tests in a copy of the project, in either precision; only in a process that has not
    imported it yet.

    What has been compiled before is kept beside the copy: a mutant changes little of it.
    """
    import pytest

    _configure(folder, double)
    return int(
        pytest.main(
            ["-q", "-W", "ignore::pytest.PytestAssertRewriteWarning", *arguments],
            plugins=list(plugins),
        )
    )


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Give the code of all functions and classes within some code."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


def _own(code: CodeType) -> tuple:
    """Give what of a code is its own, and not its functions'."""
    return (
        code.co_code,
        code.co_names,
        [repr(each) for each in code.co_consts if not isinstance(each, CodeType)],
    )


def _key(code: CodeType) -> tuple:
    return code.co_qualname, code.co_firstlineno


class _Worker:
    """Lives in a process of its own."""

    def __init__(self, folder: Path, double: bool):
        from jaxtyping import install_import_hook

        _configure(folder, double)
        self.folder = folder
        with install_import_hook(*_HOOK):
            import splatjax

            for module in pkgutil.walk_packages(splatjax.__path__, "splatjax."):
                if "cli" not in module.name and "__main__" not in module.name:
                    importlib.import_module(module.name)
        self.functions, self.of_module = {}, {}
        for each in gc.get_objects():
            if isinstance(each, FunctionType) and "splatjax" in each.__code__.co_filename:
                self.functions.setdefault(each.__code__.co_filename, []).append(each)
        for module in [
            module for name, module in sys.modules.items() if name.startswith("splatjax")
        ]:
            self.of_module[module.__file__] = module

    def meet(self, path: str, source: bytes, tests: list[str]) -> str:
        """Run tests with another text in the place of a file."""
        file = str(self.folder / path)
        loader = self.of_module[file].__loader__
        codes = [
            loader.source_to_code(text, file)
            for text in ((self.folder / path).read_bytes(), source)
        ]
        before, after = ({_key(each): each for each in [code, *_codes(code)]} for code in codes)
        changed = {
            key for key in after if key not in before or _own(before[key]) != _own(after[key])
        }
        living = {_key(each.__code__): each for each in self.functions[file]}
        outer = {
            key
            for key in changed
            if not any(key[0].startswith(f"{each[0]}.<locals>") or key == each for each in living)
        }
        if outer:
            return "imported"
        if not changed:
            return "lives"
        replaced = [
            (each, each.__code__) for each in self.functions[file] if _key(each.__code__) in after
        ]
        try:
            for function, code in replaced:
                function.__code__ = after[_key(code)]
            return _told(self._run(tests))
        finally:
            for function, code in replaced:
                function.__code__ = code

    def _run(self, tests: list[str]) -> int:
        import equinox as eqx
        import jax
        import pytest

        gc.unfreeze()
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None)).startswith(str(self.folder / "tests")):
                del sys.modules[name]
        for each in gc.get_objects():
            if isinstance(each, functools._lru_cache_wrapper) and each.__module__.startswith(
                "splatjax"
            ):
                each.cache_clear()
        eqx.clear_caches()
        jax.clear_caches()
        gc.collect()
        return int(
            pytest.main(
                [
                    "-q",
                    "-x",
                    "--tb=line",
                    "-W",
                    "ignore::pytest.PytestAssertRewriteWarning",
                    "-o",
                    _PLAIN,
                    *tests,
                ]
            )
        )


def _told(status: int) -> str:
    if status not in (0, 1, 2, 5):  # 2: tests cannot be imported
        raise RuntimeError(f"pytest ended with status {status}")
    return "lives" if status in (0, 5) else "killed"


def _work(pipe: Connection, folder: Path, double: bool) -> None:
    _speak_into(folder.parent / "worker")
    worker = _Worker(folder, double)
    pipe.send("ready")
    while True:
        try:
            given = pipe.recv()
        except EOFError:
            os._exit(0)
        try:
            pipe.send(worker.meet(*given))
        except Exception as error:
            traceback.print_exc()
            pipe.send(f"broken: {error}")


def _processor_seconds(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Meeting:
    """Where mutants meet tests: a worker, and another when it does not answer in time or has had
    enough.
    """

    def __init__(self, folder: Path, double: bool):
        self.folder, self.double, self.process, self.had = folder, double, None, 0

    def meet(self, path: str, source: bytes, tests: list[str], limit: float) -> tuple[str, float]:
        """Give what becomes of a mutant, and the seconds of processor time that it took.

        `lives`, `killed`, `too slow`, or `imported` for one that needs a process of its own.
        """
        if self.process is None or self.had >= _FEWER:
            self.end()
            self.pipe, theirs = multiprocessing.Pipe()
            self.process = multiprocessing.get_context("fork").Process(
                target=_work, args=(theirs, self.folder, self.double)
            )
            self.process.start()
            theirs.close()
            assert self.pipe.recv() == "ready"
            self.had = 0
        self.had += 1
        begin = _processor_seconds(self.process.pid)
        self.pipe.send((path, source, tests))
        while not self.pipe.poll(0.2):
            if not self.process.is_alive():
                break
            if _processor_seconds(self.process.pid) - begin > limit:
                self.end()
                return "too slow", limit
        try:
            fate = self.pipe.recv()
        except EOFError:  # it broke down, as it does not without the mutant
            self.end()
            return "killed", 0.0
        return fate, _processor_seconds(self.process.pid) - begin

    def end(self) -> None:
        """End the worker."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.pipe.close()
            self.process = None
