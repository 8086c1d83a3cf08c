"""What the README and the pages tell their readers to type: commands, programs, and files to
write.
"""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_TYPED = re.compile(r"^ {4}((?:splatjax|make|python) .*)$", re.MULTILINE)
_CONTINUED = re.compile(r" \\\n +")
_QUOTED = re.compile(r"`((?:splatjax|make|python) [^`]*)`")


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def fences(page: Path, language: str) -> list[str]:
    return [
        body
        for found, body in _FENCE.findall(page.read_text(encoding="utf-8"))
        if found == language
    ]


def commands(page: Path, *, quoted: bool = False) -> list[str]:
    """Give the command lines of a page without their comments; those in running text too, if they
    are to be `quoted`.
    """
    prose = _CONTINUED.sub(" ", _FENCE.sub("", page.read_text(encoding="utf-8")))
    lines = [*_TYPED.findall(prose), *(_QUOTED.findall(prose) if quoted else [])]
    return [re.split(r"\s+#", " ".join(line.split()))[0] for line in lines]


def words(command: str) -> list[str]:
    """Give the words of a command after `splatjax`, without where its output is led to."""
    typed = shlex.split(command)[1:]
    return typed[: typed.index(">")] if ">" in typed else typed
