"""Every command of README and docs is understood, every name and link leads somewhere, every
program names what is there; what commands and programs can do on small stand-ins is run. Words that
were replaced stay out of names, of docstrings and comments, and of pages.
"""

import ast
import contextlib
import dataclasses
import importlib
import inspect
import os
import pkgutil
import re
import shlex
import tokenize
import tomllib
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from stand_ins import WITH_CONTEXT, context, lay_out, lay_out_frame

import splatjax as sj
from splatjax.cli import main
from splatjax.cli._main import parsed

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


# Options that make a command quick; the last one given counts.
SMALL = {
    "render": ["--width", "32", "--height", "32", "--light-elevation", "30"],
    "turntable": ["--width", "32", "--height", "32", "--frames", "2", "--light-elevation", "30"],
    "sample": ["--count", "1500"],
    "recover": ["--count", "3", "--no-suggest"],
}

# These take minutes or hours: that there is such a target, and such a module with such options, is
# tested.
NOT_RUN = "make", "python"

typed = [
    pytest.param(command, id=f"{name(page)}-{number}")
    for page in PAGES
    for number, command in enumerate(commands(page, quoted=True))
    if command.startswith("splatjax")
    and (" --" in command or command in commands(page))
    and "COMMAND" not in command
]
others = sorted(
    {
        command
        for page in PAGES
        for command in commands(page, quoted=True)
        if command.split()[0] in NOT_RUN
    }
)


@pytest.mark.parametrize("command", typed)
def test_the_command_line_understands(command):
    given = words(command)
    stopping = {"--help", "--version", "--tyro-print-completion"} & set(given)
    with pytest.raises(SystemExit) if stopping else contextlib.nullcontext() as stopped:
        parsed(given)
    assert stopped is None or not stopped.value.code


targets = set(
    re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
)


@pytest.mark.parametrize("command", [command for command in others if command.startswith("make")])
def test_make_has_such_a_target(command):
    words = shlex.split(command)[1:]
    assert {word for word in words if not word.startswith("-") and "=" not in word} <= targets


@pytest.mark.parametrize(
    "workflow", sorted((ROOT / ".github" / "workflows").iterdir()), ids=lambda path: path.stem
)
def test_a_workflow_makes_what_there_is(workflow):
    text = workflow.read_text(encoding="utf-8")
    used = set(re.findall(r"run: make ([a-z-]+)$", text, re.MULTILINE))
    for several in re.findall(r"suite: \[(.*)\]", text):
        used |= set(several.split(", "))
    assert used
    assert used <= targets


@pytest.mark.parametrize("command", [command for command in others if command.startswith("python")])
def test_there_is_such_a_module_with_such_options(command):
    first, *rest = shlex.split(command)[1:]
    if first == "-c" or rest[:1] == ["pytest"]:
        assert all((ROOT / word).exists() for word in rest if "/" in word)
        return
    path = ROOT / (rest.pop(0).replace(".", "/") if first == "-m" else first)
    path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    source = path.read_text(encoding="utf-8")
    assert [word for word in rest if word.startswith("--") and f'"{word}"' not in source] == []


@pytest.mark.long
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page))
        for page in PAGES
        if any(c.startswith("splatjax") for c in commands(page))
    ],
)
def test_the_commands_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lay_out(tmp_path, page.read_text(encoding="utf-8"))
    for body in fences(page, "toml"):
        if file := re.match(r"# (\S+\.toml)\n", body):  # a file that a page lists
            body = re.sub(r"\bbust = \d+", "bust = 1500", body)
            body = re.sub(r"\b(width|height) = \d+", r"\1 = 32", body)
            (tmp_path / file[1]).write_text(body, encoding="utf-8")
    for command in commands(page):
        given = words(command)
        # The page of `studio` stays until it is interrupted.
        is_other = not command.startswith("splatjax") or given[0].startswith("-")
        if is_other or "--help" in given or given[0] == "studio":
            continue
        is_scene = given[0] == "render" and given[1].endswith((".toml", ".exr"))
        small = [] if is_scene else SMALL.get(given[0], [])
        small = small[:-2] if "--environment" in given else small  # without a single light
        if (
            given[0] in ("render", "turntable")
            and not is_scene
            and not any(word.endswith(".ply") for word in given)
        ):
            small = [*small, "--count", "1500"]
        if "--photons" in given or "monte-carlo" in given:
            small = [*small, "--photons", "20000", "--count", "3"]
        before = set(os.listdir())
        assert main([*given, *small]) == 0, command
        output = given[given.index("--output") + 1] if "--output" in given else None
        assert output is None or output in os.listdir(), command
        assert output is not None or given[0] == "materials" or set(os.listdir()) > before


MATERIALS = (ROOT / "docs" / "materials.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("heading", "record"),
    [("Surface", sj.Material), ("Pigments of skin", sj.scattering.Skin)],
)
def test_the_tables_of_parameters_have_the_defaults_and_ranges_of_the_records(heading, record):
    _, section = MATERIALS.split(f"### {heading}\n")
    lines = re.findall(r"^\| `(\w+)` \|(.*)\|$", section.split("\n### ")[0], re.MULTILINE)
    rows = {name: cells.replace("\N{MINUS SIGN}", "-").split(" | ") for name, cells in lines}
    numbers = [
        field for field in dataclasses.fields(record) if isinstance(field.default, int | float)
    ]
    assert {field.name for field in numbers} == rows.keys() - {"wavelengths"}
    for field in numbers:
        *_, limits, default = rows[field.name]
        assert float(default.split(";")[0]) == field.default
        between = re.match(r"between (\S+) and (\S+)", field.metadata["valid"][0])
        assert between is None or limits == f"{between[1]} to {between[2]}"


EQUATIONS = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")


def named_objects(text):
    return list(dict.fromkeys(re.findall(r"`(splatjax(?:\.\w+)+)`", text)))


@pytest.mark.parametrize("path", named_objects(EQUATIONS))
def test_every_named_object_exists_and_says_what_it_is(path):
    named = pkgutil.resolve_name(path)
    assert callable(named)
    assert named.__doc__


@pytest.mark.parametrize(
    "row", ["Eq. 1", "Eq. 2", "Eq. 3", "Eq. 4", "Pass 1", "Pass 2", "Pass 3", "Pass 4", "Pass 5"]
)
def test_every_equation_and_pass_has_its_row(row):
    (line,) = (line for line in EQUATIONS.splitlines() if line.startswith(f"| {row} |"))
    assert row.startswith("Pass") or row in pkgutil.resolve_name(named_objects(line)[0]).__doc__


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=name)
def test_links_and_named_files_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target
    if page.name not in ("CHANGELOG.md", "CONTRIBUTING.md"):  # files of the past, and yours
        for named in re.findall(r"`((?:splatjax|tests|tools|benchmarks|notebooks)/\S+\.py)`", text):
            assert (ROOT / named).is_file(), named


def test_the_readme_measures_as_its_pages_do():
    """Every number of its table against others stands on the page that the row, or one above it,
    links to, where it may have more digits; a list of numbers stands there as it is.
    """
    number = r"(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.]\d)"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    section = readme.partition("## Measured against others")[2].partition("\n##")[0]
    rows = [line.split("|") for line in section.splitlines() if "|" in line]
    page = None
    for _, _, ours, others, source, _ in rows[2:]:
        page = next(iter(re.findall(r"\]\(([^)#]+)", source)), page)
        text, cells = (ROOT / page).read_text(encoding="utf-8"), ours + others
        assert [
            each for each in re.findall(r"\d[\d., ]+, \d[\d.]*%", cells) if each not in text
        ] == []
        on_page = [float(each) for each in re.findall(number, text)]
        for given in re.findall(number, cells.replace("Mitsuba 3", "")):
            digits = len(given.partition("e")[0].replace(".", "").lstrip("0"))
            assert float(given) in [float(f"{each:.{digits}g}") for each in on_page], given


WITH_PROGRAMS = [pytest.param(page, id=name(page)) for page in PAGES if fences(page, "python")]


def _small(program: str) -> str:
    program = re.sub(r"sj\.bust\([\d_]+\)", "sj.bust(1_500)", program)
    program = re.sub(r"(sample_mesh\([^,]*, )[\d_]+", r"\g<1>1_500", program)
    program = program.replace("512, 512", "32, 32")
    return re.sub(r"(fov=[\d.]+)\)", r"\1, width=32, height=32)", program)


def _attribute(node: ast.expr):
    if isinstance(node, ast.Name) and node.id == "sj":
        return sj
    owner = _attribute(node.value) if isinstance(node, ast.Attribute) else None
    return getattr(owner, node.attr) if inspect.ismodule(owner) else None


@pytest.mark.parametrize("page", WITH_PROGRAMS)
def test_what_programs_name_is_there(page):
    for node in ast.walk(ast.parse("\n".join(fences(page, "python")))):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("splatjax"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.util.find_spec(
                    f"{node.module}.{alias.name}"
                )
        called = _attribute(node.func) if isinstance(node, ast.Call) else _attribute(node)
        if isinstance(node, ast.Call) and called is not None:
            known = inspect.signature(called).parameters
            assert {word.arg for word in node.keywords} <= set(known), called


@pytest.mark.slow
def test_the_first_program_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sj.cache, "keep", lambda **_: None)
    first, *_ = fences(ROOT / "README.md", "python")
    exec(compile(_small(first), "README.md", "exec"), {})
    assert {path.name for path in tmp_path.iterdir()} == {"bust.exr", "bust.png"}


@pytest.mark.long
@pytest.mark.parametrize("page", WITH_PROGRAMS)
def test_the_programs_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sj.cache, "keep", lambda **_: None)
    text = "\n".join(fences(page, "python"))
    lay_out(tmp_path, text)
    lay_out_frame(tmp_path, text)
    monkeypatch.setattr(jax.distributed, "initialize", lambda: None)
    names = context() if name(page) in WITH_CONTEXT else {}
    for program in fences(page, "python"):
        exec(compile(_small(program), name(page), "exec"), names)
    for what, value in names.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(
            eqx.filter(value, eqx.is_inexact_array)
        ):
            # Pixels that do not count are NaN in these.
            if not jax.tree_util.keystr(path).startswith((".pictures", ".residuals")):
                assert not np.any(np.isnan(leaf)), what


WORDS = tomllib.loads((Path(__file__).parent / "glossary.toml").read_text(encoding="utf-8"))
PHRASES = re.compile(rf"\b({'|'.join(WORDS['prose'])})\b".replace(" ", r"\s+"), re.IGNORECASE)
FOLDERS = ("splatjax", "tests", "tools", "benchmarks", "notebooks", "docs")
MORE = [*ROOT.glob("*.md"), *(ROOT / each for each in ("Makefile", "mkdocs.yml", "pyproject.toml"))]


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
    faults = {path: in_code(path) for each in FOLDERS for path in (ROOT / each).rglob("*.py")}
    pages = [*MORE, *(path for each in FOLDERS for path in (ROOT / each).rglob("*.md"))]
    faults |= {path: in_prose(path.read_text(encoding="utf-8")) for path in pages}
    lines = [
        f"{path.relative_to(ROOT)}:{line}: {words!r}, use {use!r}"
        for path, found in faults.items()
        for line, words, use in found
    ]
    assert not lines, "\n".join(lines)
