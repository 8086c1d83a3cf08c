"""Words that were replaced stay out of names, of docstrings and comments, and of pages."""

import re
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
WORDS = tomllib.loads((Path(__file__).parent / "glossary.toml").read_text(encoding="utf-8"))
PHRASES = re.compile(rf"\b({'|'.join(WORDS['prose'])})\b".replace(" ", r"\s+"), re.IGNORECASE)
FOLDERS = ("splatjax", "tests", "tools", "benchmarks", "notebooks", "docs")
MORE = [*ROOT.glob("*.md"), *(ROOT / name for name in ("Makefile", "mkdocs.yml", "pyproject.toml"))]


def in_prose(text: str, line: int = 1) -> list[tuple[int, str, str]]:
    """Return line, words and replacement of each listed phrase of a text that begins in a line."""
    return [
        (line + text.count("\n", 0, match.start()), words, WORDS["prose"][words])
        for match in PHRASES.finditer(text)
        for words in [" ".join(match[0].lower().split())]
    ]


def in_code(path: Path) -> list[tuple[int, str, str]]:
    """Return line, words and replacement of each listed name and phrase of a module."""
    faults, before = [], ""
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type == tokenize.COMMENT or token.string.lstrip("rf").startswith('"""'):
                faults += in_prose(token.string, token.start[0])
            elif token.string in WORDS["identifiers"] and before != ".":  # of other libraries
                faults.append((token.start[0], token.string, WORDS["identifiers"][token.string]))
            before = token.string
    return faults


def test_words_that_were_replaced_do_not_come_back():
    faults = {path: in_code(path) for name in FOLDERS for path in (ROOT / name).rglob("*.py")}
    pages = [*MORE, *(path for name in FOLDERS for path in (ROOT / name).rglob("*.md"))]
    faults |= {path: in_prose(path.read_text(encoding="utf-8")) for path in pages}
    lines = [
        f"{path.relative_to(ROOT)}:{line}: {words!r}, use {use!r}"
        for path, found in faults.items()
        for line, words, use in found
    ]
    assert not lines, "\n".join(lines)
