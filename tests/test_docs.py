"""Documents are held to the code: names exist, links lead somewhere, the program of the README
runs.
"""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EQUATIONS = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")),
    *sorted((ROOT / "docs").rglob("*.md")),
]


def named_objects(text):
    return sorted(set(re.findall(r"`(splatjax(?:\.\w+)+)`", text)))


@pytest.mark.parametrize("name", named_objects(EQUATIONS))
def test_every_named_object_exists_and_says_what_it_is(name):
    module, _, attribute = name.rpartition(".")
    named = getattr(importlib.import_module(module), attribute)
    assert callable(named)
    assert named.__doc__


@pytest.mark.parametrize(
    "row", ["Eq. 1", "Eq. 2", "Eq. 3", "Eq. 4", "Pass 1", "Pass 2", "Pass 3", "Pass 4", "Pass 5"]
)
def test_every_equation_and_pass_has_its_row(row):
    lines = [line for line in EQUATIONS.splitlines() if line.startswith(f"| {row} |")]
    assert len(lines) == 1
    assert named_objects(lines[0])


@pytest.mark.parametrize("equation", [1, 2, 3, 4])
def test_the_function_of_an_equation_names_it(equation):
    line = next(line for line in EQUATIONS.splitlines() if line.startswith(f"| Eq. {equation} |"))
    name = re.search(r"`(splatjax(?:\.\w+)+)`", line).group(1)
    module, _, attribute = name.rpartition(".")
    assert f"Eq. {equation}" in getattr(importlib.import_module(module), attribute).__doc__


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (page.parent / target).exists(), target


@pytest.mark.slow
@pytest.mark.once
def test_the_program_of_the_readme_runs(tmp_path, monkeypatch):
    program = re.search(r"```python\n(.*?)```", README, re.DOTALL).group(1)
    small = program.replace("100_000", "2_000").replace("fov=30", "fov=30, width=48, height=48")
    assert small.count("2_000") == 1
    assert small.count("width=48") == 1
    monkeypatch.chdir(tmp_path)
    exec(compile(small, "README.md", "exec"), {})
    assert (tmp_path / "bust.exr").exists()
    assert (tmp_path / "bust.png").exists()
