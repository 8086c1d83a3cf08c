"""From words on a command line to a command, and from an error to one clear line."""

import sys
from collections.abc import Sequence
from typing import Annotated

import equinox as eqx
import tyro

from ._environment import prepare_jax
from ._export import Export
from ._figure import Figure
from ._fit import Fit
from ._materials import Materials
from ._recover import Recover
from ._render import Render
from ._sample import Sample
from ._turntable import Turntable

_Command = (
    Annotated[Materials, tyro.conf.subcommand("materials")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Sample, tyro.conf.subcommand("sample")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Recover, tyro.conf.subcommand("recover")]
    | Annotated[Turntable, tyro.conf.subcommand("turntable")]
    | Annotated[Figure, tyro.conf.subcommand("figure")]
)
_DESCRIPTION = """Render translucent materials, and find the sums of Gaussians that stand for them. Lengths are in mm.

`splatjax COMMAND --help` explains a command."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command.

    **Arguments:**

    - `args`: the words after `splatjax`; those of the process when not given.

    **Returns:** the exit status: 0, or 2 after one line on stderr that says what is wrong; 130 when interrupted.
    """
    command = tyro.cli(_Command, prog="splatjax", description=_DESCRIPTION, args=args)
    try:
        prepare_jax()
        command.run()
    except (ValueError, OSError, eqx.EquinoxRuntimeError) as error:
        print(f"splatjax: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("splatjax: interrupted", file=sys.stderr)
        return 130
    return 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__
