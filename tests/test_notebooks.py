"""Every notebook runs from top to bottom, and ends with what it claims."""

import sys
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
LONG = {"gradients", "painted_skin", "recover_marble", "shape_from_shading", "which_profile"}
"""They take more than half a minute: `make test-long` runs them, `make test` does not."""


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.long if path.stem in LONG else (), id=path.stem)
        for path in sorted(NOTEBOOKS.glob("*.py"))
    ],
)
def test_notebook_runs_and_proves_its_claim(path, tmp_path, monkeypatch):
    notebook = jupytext.read(path)
    if any("monte_carlo" in cell.source for cell in notebook.cells):
        monkeypatch.delenv("XLA_FLAGS", raising=False)  # compiled as users have it: walks run longer than they compile
    assert "assert" in notebook.cells[-1].source
    # The interpreter of the tests, whatever kernels are installed.
    notebook.metadata.kernelspec = {"name": "python3", "display_name": sys.version, "language": "python"}
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    nbformat.validate(notebook)
    pictures = [out for cell in notebook.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert pictures
