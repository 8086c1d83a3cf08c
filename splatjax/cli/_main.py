"""From words on a command line to a command, and from an error to one clear line."""

import functools
import inspect
import operator
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import equinox as eqx
import jax
import tyro

from splatjax.io import own_version

from ._environment import prepare_jax
from ._export import Export
from ._fit import Fit
from ._materials import Materials
from ._recover import Recover
from ._render import Render
from ._report import note
from ._sample import Sample
from ._turntable import Turntable

_COMMANDS = {
    "materials": Materials,
    "fit": Fit,
    "export": Export,
    "sample": Sample,
    "render": Render,
    "turntable": Turntable,
    "recover": Recover,
}
_DESCRIPTION = """Render translucent materials, and find the sums of Gaussians that stand for them.
Lengths are in mm.

`splatjax COMMAND --help` explains a command. With --debug, an error shows where it arose.
`splatjax --version` says which version this is."""
_DEBUG = "--debug"
_STYLE = (tyro.conf.PositionalMetavarFromFieldName,)


def main(args: Sequence[str] | None = None) -> int:
    """Run one command.

    **Arguments:**

    - `args`: the words after `splatjax`; those of the process when not given.

    **Returns:** the exit status: 0; 2 after one line on stderr that says what is wrong with what
    was given; 1 after one that says what is wrong with splatjax; 130 when interrupted, 141 when
    nobody reads on.
    """
    words = list(sys.argv[1:] if args is None else args)
    debug = _DEBUG in words
    try:
        command = parsed([word for word in words if word != _DEBUG])
    except BrokenPipeError:
        return _nobody_reads_on()
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # ty: ignore[invalid-assignment]
            prepare_jax()
            command.run()
            sys.stdout.flush()
    except (BrokenPipeError, SystemExit):  # of a pipe that rich was writing to
        return _nobody_reads_on()
    except KeyboardInterrupt:
        print("splatjax: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if debug:
            traceback.print_exc()
        said, status = _said(error)
        print(f"splatjax: {said}", file=sys.stderr)
        return status
    return 0


def _nobody_reads_on() -> int:
    os.dup2(
        os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
    )  # Python would try once more when it ends
    return 141


def parsed(words: list[str]) -> Any:
    """Give the command that words stand for; raise `SystemExit` where they ask for help or the
    version, or stand for none.

    The command of the first word alone is looked at, so that what is said speaks of nothing else.
    """
    name, *rest = words or ["--help"]
    if name == "--version":
        print(f"splatjax {own_version()}, jax {jax.__version__}")
        raise SystemExit
    if name in _COMMANDS:
        return tyro.cli(_COMMANDS[name], prog=f"splatjax {name}", args=rest, config=_STYLE)
    each = [
        Annotated[command, tyro.conf.subcommand(name, description=_summary(command))]
        for name, command in _COMMANDS.items()
    ]
    union: Any = functools.reduce(operator.or_, each)
    return tyro.cli(
        union, prog="splatjax", description=_DESCRIPTION, args=[name, *rest], config=_STYLE
    )


def _summary(command: type) -> str:
    return (inspect.getdoc(command) or "").partition("\n")[0]


def _said(error: Exception) -> tuple[str, int]:
    """Give one line about an error, and the exit status: 2 for what the user can mend, 1 for what
    we must.
    """
    words = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}", 2
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in words:
        return "this takes more memory than there is; take fewer splats, or a smaller picture", 2
    if isinstance(error, eqx.EquinoxRuntimeError):
        return _said_in_compiled_code(str(error)), 2
    if isinstance(error, ValueError | OSError):
        return words or type(error).__name__, 2
    return (
        f"a fault of splatjax itself: {type(error).__name__}: {words}; please report it with what "
        f"{_DEBUG} shows",
        1,
    )


def _said_in_compiled_code(words: str) -> str:
    """Give what a check in compiled code says, without the stack before it and the advice to
    developers behind it.
    """
    return " ".join(words.rpartition("EquinoxRuntimeError: ")[2].partition("\n\n---")[0].split())


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Show what a user should know in one line; what is meant for developers not at all."""
    if issubclass(category, UserWarning):
        note(" ".join(str(message).split()))
