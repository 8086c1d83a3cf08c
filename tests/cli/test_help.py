"""Help, versions, and words that the command line does not know."""

import re
from dataclasses import fields

import jax
import pytest

import splatjax as sj
from splatjax.cli import main
from splatjax.cli._main import _COMMANDS


@pytest.fixture
def printed(monkeypatch, capsys):
    """Return how to get what words print, in a terminal so wide that no line is broken."""
    monkeypatch.setenv("COLUMNS", "3000")

    def run(*words, status=0):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        assert (stopped.value.code or 0) == status
        captured = capsys.readouterr()
        return captured.err if status else captured.out

    return run


def test_help_lists_every_command_in_one_line_each(printed):
    listed = re.findall(r"• (\w+) +(.*?) *│? *\n", printed("--help"))
    assert [name for name, _ in listed] == list(_COMMANDS)
    assert all(summary.endswith(".") and len(summary) < 100 for _, summary in listed)
    assert printed() == printed("--help")


@pytest.mark.parametrize("command", _COMMANDS)
def test_help_of_a_command_explains_every_option_in_whole_sentences(command, printed):
    text = printed(command, "--help")
    assert not [word for word in ("None", "STR", "{None}", "|FLOAT") if word in text]
    lines = [line.strip("│ ") for line in text.partition("-h, --help")[2].splitlines()[1:]]
    lines = [line for line in lines if line and line[0] not in "╭╰"]
    broken = [line for line in lines if line[-1] not in ".)" and ("  " in line or line[:2] != "--")]
    assert not broken
    assert len(lines) >= len(fields(_COMMANDS[command])) - text.count("positional arguments")


def test_a_misspelt_word_is_named_with_what_would_be_right(printed):
    text = printed("render", "--widht", "3", status=2)
    assert "--widht" in text
    assert text.count("--width") == 1  # of this command alone
    assert all(command in printed("rendr", status=2) for command in _COMMANDS)


def test_it_prints_its_version(printed):
    assert printed("--version") == f"splatjax {sj.__version__}, jax {jax.__version__}\n"
