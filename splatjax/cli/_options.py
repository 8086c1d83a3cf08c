"""Types of options, as help shows them. What takes more than a line to explain is a `help`: breaks
in docstrings are kept.
"""

from pathlib import Path
from typing import Annotated, Literal

import tyro

OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")]
UpAxis = Literal["y", "z"]
MaterialName = Annotated[str, tyro.conf.arg(metavar="MATERIAL")]
MaterialNames = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MATERIAL [MATERIAL ...]")]
