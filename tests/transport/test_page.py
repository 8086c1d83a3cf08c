"""The page "which profile when" is held to the walks and models of today, with fewer photons."""

import importlib.util
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parents[2]
PHOTONS = 100_000


def tool():
    spec = importlib.util.spec_from_file_location(
        "make_which_profile", ROOT / "tools" / "make_which_profile.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cells(rows) -> list[list[str]]:
    return [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]


@pytest.mark.long
def test_the_table_is_what_the_tool_gives_today(float32):
    made = tool()
    page = made.PAGE.read_text(encoding="utf-8")
    written = cells(page.split(made.BEGIN)[1].split(made.END)[0].strip().splitlines()[2:])
    with jax.enable_x64(True):
        found = cells(made.slabs(PHOTONS))
    places = [place for place, row in enumerate(written) if row[0] == found[0][0]]
    assert len(places) == 1
    models = {row[2] for row in written}
    assert models == {
        "Dipole",
        "BetterDipole",
        "PhotonBeam",
        "Burley",
        "Multipole",
        "LayeredMultipole",
    }
    for row, old in zip(found, written[places[0] :], strict=False):
        assert row[0] == old[0]
        # Half a per cent: three standard errors of a tenth of the photons.
        assert abs(float(row[1]) - float(old[1])) < 0.005
        if old[3] != "refused":
            assert abs(float(row[3].rstrip("%")) - float(old[3].rstrip("%"))) < 1.5
            assert abs(float(row[4]) - float(old[4])) < 0.05
