"""Documents are held to the code: names exist, links lead somewhere, the program of the README
runs.
"""

import pkgutil
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
    return list(dict.fromkeys(re.findall(r"`(splatjax(?:\.\w+)+)`", text)))


@pytest.mark.parametrize("name", named_objects(EQUATIONS))
def test_every_named_object_exists_and_says_what_it_is(name):
    named = pkgutil.resolve_name(name)
    assert callable(named)
    assert named.__doc__


@pytest.mark.parametrize(
    "row", ["Eq. 1", "Eq. 2", "Eq. 3", "Eq. 4", "Pass 1", "Pass 2", "Pass 3", "Pass 4", "Pass 5"]
)
def test_every_equation_and_pass_has_its_row(row):
    (line,) = (line for line in EQUATIONS.splitlines() if line.startswith(f"| {row} |"))
    function = pkgutil.resolve_name(named_objects(line)[0])
    assert row.startswith("Pass") or row in function.__doc__


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
