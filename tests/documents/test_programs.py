"""Every program of README and docs names what is there; all are run, small."""

import ast
import importlib
import inspect
import re

import equinox as eqx
import jax
import numpy as np
import pytest
from pages import PAGES, ROOT, fences, name
from stand_ins import WITH_CONTEXT, context, lay_out, lay_out_frame

import splatjax as sj

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
@pytest.mark.once
def test_the_first_program_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, *_ = fences(ROOT / "README.md", "python")
    exec(compile(_small(first), "README.md", "exec"), {})
    assert {path.name for path in tmp_path.iterdir()} == {"bust.exr", "bust.png"}


@pytest.mark.long
@pytest.mark.once
@pytest.mark.parametrize("page", WITH_PROGRAMS)
def test_the_programs_of_a_page_run_one_after_the_other(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "\n".join(fences(page, "python"))
    lay_out(tmp_path, text)
    lay_out_frame(tmp_path, text)
    monkeypatch.setattr(jax.distributed, "initialize", lambda: None)
    names = context() if name(page) in WITH_CONTEXT else {}
    for program in fences(page, "python"):
        exec(compile(_small(program), name(page), "exec"), names)
    for what, value in names.items():
        for leaf in jax.tree.leaves(eqx.filter(value, eqx.is_inexact_array)):
            assert not np.any(np.isnan(leaf)), what


def test_every_context_is_of_a_page_with_programs():
    assert {param.id for param in WITH_PROGRAMS} >= WITH_CONTEXT
