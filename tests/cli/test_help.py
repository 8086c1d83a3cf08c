"""What the command line says of itself, and of words it does not know."""

import re
from dataclasses import fields

import jax
import pytest

import splatjax as sj
from splatjax.cli import main
from splatjax.cli._main import _COMMANDS


def said(words: list[str], capsys: pytest.CaptureFixture[str], status: int = 0) -> str:
    """Give what words make it say before it stops."""
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert (stopped.value.code or 0) == status
    printed = capsys.readouterr()
    return printed.err if status else printed.out


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Give a terminal on which nothing needs to be broken."""
    monkeypatch.setenv("COLUMNS", "3000")


def test_help_lists_every_command_in_one_line_each(capsys):
    listed = re.findall(r"• (\w+) +(.*?) *│? *\n", said(["--help"], capsys))
    assert [name for name, _ in listed] == list(_COMMANDS)
    assert all(summary.endswith(".") and len(summary) < 100 for _, summary in listed)


def test_no_words_at_all_are_a_call_for_help(capsys):
    assert said([], capsys) == said(["--help"], capsys)


@pytest.mark.parametrize("command", _COMMANDS)
def test_help_of_a_command_breaks_no_sentence(command, capsys):
    printed = said([command, "--help"], capsys)
    options = printed.partition("-h, --help")[2].splitlines()[1:]
    told = [line.strip("│ ") for line in options if line[:2] in ("│ ", "  ") and line.strip("│ ")]
    assert all(line[-1] in ".)" or (line.startswith("--") and "  " not in line) for line in told), (
        told
    )
    assert len(told) >= len(fields(_COMMANDS[command])) - printed.count("positional arguments")


@pytest.mark.parametrize("command", _COMMANDS)
def test_help_speaks_of_no_types_of_python(command, capsys):
    printed = said([command, "--help"], capsys)
    for word in ("None", "STR", "{None}", "|FLOAT"):
        assert word not in printed


def test_a_misspelt_option_is_compared_with_those_of_its_command_alone(capsys):
    printed = said(["render", "--widht", "3"], capsys, status=2)
    assert "--widht" in printed
    assert printed.count("--width") == 1


def test_a_misspelt_command_is_told_the_commands(capsys):
    printed = said(["rendr"], capsys, status=2)
    assert all(command in printed for command in _COMMANDS)


def test_it_says_its_version(capsys):
    assert said(["--version"], capsys) == f"splatjax {sj.__version__}, jax {jax.__version__}\n"
