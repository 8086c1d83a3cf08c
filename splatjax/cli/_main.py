"""Parse the command line, run a command, and report errors in one line. Also choose the settings
that a library leaves to the program: the cache of compiled code, the device, and the reuse of
memory.
"""

import contextlib
import ctypes
import functools
import operator
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NoReturn

import equinox as eqx
import jax
import tyro

import splatjax as sj

from ._fit import Fit
from ._materials import Export, Materials, Sample
from ._recover import Recover
from ._render import Render, Turntable
from ._studio import Studio
from ._terminal import CONSOLE, note

_COMMANDS = {
    "materials": Materials,
    "fit": Fit,
    "export": Export,
    "sample": Sample,
    "render": Render,
    "turntable": Turntable,
    "studio": Studio,
    "recover": Recover,
}
_DESCRIPTION = """Render translucent materials, and fit the sums of Gaussians that represent them.
Lengths are in mm.

`splatjax COMMAND --help` explains a command. --debug adds the traceback to an error.
`splatjax --version` prints the version."""
_DEBUG = "--debug"
_PATIENCE = 3.0  # s, until a program that does not notice an interruption is ended
# Options of XLA, with which a picture compiles in three quarters of the time and renders a tenth
# slower.
_OF_ONE_PICTURE = {"xla_cpu_use_fusion_emitters": False}
# Options of glibc (malloc.h): one arena, no separate mappings, and no memory returned to the
# system.
_MALLOPT = {"M_ARENA_MAX": (-8, 1), "M_MMAP_MAX": (-4, 0), "M_TRIM_THRESHOLD": (-1, 2**31 - 1)}


def main(args: Sequence[str] | None = None) -> int:
    """Run one command.

    **Arguments:**

    - `args`: the words after `splatjax`, by default those of the command line.

    **Returns:** the exit status: 0 for success; 2 for invalid input and 1 for a fault of splatjax,
    both with one line on stderr; 130 if interrupted; 141 if stdout is a closed pipe.
    """
    words = list(sys.argv[1:] if args is None else args)
    try:
        command = parsed([word for word in words if word != _DEBUG])
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # ty: ignore[invalid-assignment]
            keep_freed_memory()
            prepare_jax(_OF_ONE_PICTURE if isinstance(command, Render) else {})
            CONSOLE.quiet = getattr(command, "quiet", False)
            try:
                command.run()
                sys.stdout.flush()
            except SystemExit:  # raised by rich when it writes to a closed pipe
                raise BrokenPipeError from None
        return 0
    except BrokenPipeError:
        # Python would write again when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        message, status = "interrupted", 130
    except Exception as error:
        if _DEBUG in words:
            traceback.print_exc()
        message, status = _message(error)
    print(f"splatjax: {message}", file=sys.stderr)
    return status


def run_and_exit() -> NoReturn:
    """Run the command of the command line, and end the process. XLA does not notice interruptions
    while it compiles, so a thread ends the process if Python does not react.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    noticed = threading.Event()

    def interrupt(*_: object) -> None:
        noticed.set()
        raise KeyboardInterrupt

    def end_unless_noticed() -> None:
        os.read(reader, 1)
        if not noticed.wait(_PATIENCE):
            print("splatjax: interrupted", file=sys.stderr, flush=True)
            os._exit(130)

    signal.signal(signal.SIGINT, interrupt)
    threading.Thread(target=end_unless_noticed, daemon=True).start()
    status = main()
    if status == 130:
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def parsed(words: list[str]) -> Any:
    """Parse words into a command. Raise `SystemExit` for help, for the version, and for words that
    are not a command.

    Only the command of the first word is parsed, so that help and errors are only about this
    command.
    """
    name, *arguments = words or ["--help"]
    style = (tyro.conf.PositionalMetavarFromFieldName,)
    if name == "--version":
        print(f"splatjax {sj.__version__}, jax {jax.__version__}")
        raise SystemExit
    if name in _COMMANDS:
        return tyro.cli(_COMMANDS[name], prog=f"splatjax {name}", args=arguments, config=style)
    commands: list[Any] = [
        Annotated[kind, tyro.conf.subcommand(key, description=str(kind.__doc__).partition("\n")[0])]
        for key, kind in _COMMANDS.items()
    ]
    return tyro.cli(
        functools.reduce(operator.or_, commands),
        prog="splatjax",
        description=_DESCRIPTION,
        args=[name, *arguments],
        config=style,
    )


def _message(error: Exception) -> tuple[str, int]:
    """Return one line about an error, and the exit status: 2 for an error that the user can fix, 1
    for a fault of splatjax.
    """
    text = str(error)
    # The message is between a stack trace and advice for developers.
    if isinstance(error, eqx.EquinoxRuntimeError):
        text = text.rpartition("EquinoxRuntimeError: ")[2].partition("\n\n---")[0]
    line = " ".join(text.split())
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}", 2
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in line:
        return "not enough memory is available; use fewer splats or a smaller picture", 2
    if isinstance(error, ValueError | OSError | eqx.EquinoxRuntimeError):
        return line or type(error).__name__, 2
    return (
        f"a fault of splatjax: {type(error).__name__}: {line}; please report it with the "
        f"output of {_DEBUG}",
        1,
    )


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning for users in one line, and no warnings for developers."""
    if issubclass(category, UserWarning):
        note(" ".join(str(message).split()))


def keep_freed_memory() -> None:
    """Let the C library, if it is glibc, keep the memory of one picture for the next.

    Otherwise the system maps and clears the buffers of every picture again.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        for parameter, value in _MALLOPT.values():
            ctypes.CDLL(None).mallopt(parameter, value)


def prepare_jax(compiler_options: Mapping[str, bool | str]) -> None:
    """Enable the cache in the user's cache folder, and compute on the CPU, unless environment
    variables specify otherwise.

    JAX's own variables (`JAX_COMPILATION_CACHE_DIR`, `JAX_PLATFORMS` and others) take precedence.
    `XDG_CACHE_HOME` moves the cache folder.
    """
    if jax.config.jax_platforms is None:  # ty: ignore[missing-attribute]
        jax.config.update("jax_platforms", "cpu")
    # Without the folder, everything is computed and compiled each time.
    with contextlib.suppress(OSError):
        sj.cache.keep(compiler_options=compiler_options)
