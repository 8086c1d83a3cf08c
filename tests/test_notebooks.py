"""Every notebook runs from top to bottom, and ends with what it claims."""

import functools
import os
import sys
from contextlib import ExitStack
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
# They take a quarter of a minute or more: `make test-long` runs them, `make test` does not.
LONG = {
    "fit_marble",
    "gradients",
    "measured_material",
    "new_material",
    "painted_skin",
    "recover_marble",
    "relight",
    "shape_from_shading",
    "skin_maps",
    "which_profile",
    *(f"figure_{number}" for number in (1, 4, 5, 6, 7, 8)),  # Figure 3 has no picture to render
}
# They are compiled as users have it, whatever the shell sets.
RUN_LONGER_THAN_THEY_COMPILE = {"shape_from_shading", "which_profile"}


@pytest.fixture(scope="module")
def clients(tmp_path_factory):
    """Give one kernel for all notebooks that compile alike: they find nothing of each other but
    what was imported.
    """
    with ExitStack() as started:

        @functools.cache
        def client(as_users: bool) -> NotebookClient:
            environment = {
                name: value
                for name, value in os.environ.items()
                if not (as_users and name == "XLA_FLAGS")
            }
            client = NotebookClient(nbformat.v4.new_notebook(), timeout=600)
            # The interpreter of the tests, whatever kernels are installed.
            client.nb.metadata.kernelspec = {
                "name": "python3",
                "display_name": sys.version,
                "language": "python",
            }
            started.enter_context(
                client.setup_kernel(cwd=str(tmp_path_factory.mktemp("notebooks")), env=environment)
            )
            return client

        yield client


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=pytest.mark.long if path.stem in LONG else (), id=path.stem)
        for path in sorted(NOTEBOOKS.glob("*.py"))
    ],
)
def test_notebook_runs_and_proves_its_claim(path, clients):
    notebook = jupytext.read(path)
    assert "assert" in notebook.cells[-1].source
    client = clients(path.stem in RUN_LONGER_THAN_THEY_COMPILE)
    client.nb = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell("%reset -f"), *notebook.cells]
    )
    client.execute(cleanup_kc=False)
    nbformat.validate(client.nb)
    pictures = [
        out
        for cell in client.nb.cells
        for out in cell.get("outputs", [])
        if "image/png" in out.get("data", {})
    ]
    assert pictures
