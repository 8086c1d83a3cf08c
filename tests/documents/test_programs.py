"""Every program of README and docs names what is there; all are run, small."""

import ast
import importlib
import inspect
import re

import equinox as eqx
import jax
import numpy as np
import pytest
from contexts import CONTEXTS
from pages import PAGES, name, programs
from stand_ins import lay_out, lay_out_frame

import splatjax as sj

WITH_PROGRAMS = [pytest.param(page, id=name(page)) for page in PAGES if programs(page)]


def _small(program: str) -> str:
    """Give a program with fewer splats and pixels."""
    program = re.sub(r"sj\.bust\([\d_]+\)", "sj.bust(1_500)", program)
    program = re.sub(r"(sample_mesh\([^,]*, )[\d_]+", r"\g<1>1_500", program)
    program = program.replace("512, 512", "32, 32")
    return re.sub(r"(fov=[\d.]+)\)", r"\1, width=32, height=32)", program)


@pytest.mark.parametrize("page", WITH_PROGRAMS)
def test_what_programs_name_is_there(page):
    for program in programs(page):
        for node in ast.walk(ast.parse(program)):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("splatjax"):
                module = importlib.import_module(node.module)
                for alias in node.names:
                    assert hasattr(module, alias.name) or importlib.util.find_spec(
                        f"{node.module}.{alias.name}"
                    )
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id == "sj"
            ):
                assert hasattr(sj, node.attr), node.attr
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and ast.unparse(node.func.value) == "sj"
            ):
                known = inspect.signature(getattr(sj, node.func.attr)).parameters
                assert {word.arg for word in node.keywords} <= set(known), node.func.attr


@pytest.mark.long
@pytest.mark.once
@pytest.mark.parametrize("page", WITH_PROGRAMS)
def test_the_programs_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "\n".join(programs(page))
    lay_out(tmp_path, text)
    lay_out_frame(tmp_path, text)
    names = CONTEXTS.get(name(page), dict)()
    for program in programs(page):
        exec(compile(_small(program), name(page), "exec"), names)
    for what, value in names.items():
        for leaf in jax.tree.leaves(eqx.filter(value, eqx.is_inexact_array)):
            assert not np.any(np.isnan(leaf)), what


def test_every_context_is_of_a_page_with_programs():
    assert set(CONTEXTS) <= {param.id for param in WITH_PROGRAMS}
