"""Many media by one command, into one table."""

import csv
import unittest.mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import failure, run

import splatjax as sj
from splatjax.cli import _fit_all

pytestmark = pytest.mark.once

HEAD = "name,sigma_a,sigma_s_prime,eta\n"
MEDIA = ["a,0.002,2.6,1.5", "b,0.5,1.0,1.3", "c,0.0,3.0,1.4", "d,0.03,0.7,1.2", "e,0.1,8.0,1.0"]


@pytest.fixture
def media(tmp_path):
    (tmp_path / "media.csv").write_text(HEAD + "\n".join(MEDIA) + "\n")
    return tmp_path / "media.csv"


def test_a_table_of_media_becomes_a_table_of_fits_and_is_continued(
    media, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(_fit_all, "_BATCH", 2)
    output = tmp_path / "fits.csv"
    words = ["fit", media, "--all", "--count", 2, "--output", output]
    with monkeypatch.context() as patch:
        interruption = unittest.mock.Mock(side_effect=KeyboardInterrupt)
        patch.setattr(_fit_all, "read_columns", interruption)
        assert run(*words) == 130
    capsys.readouterr()
    assert run(*words) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{output}\n"
    assert "3 of 3 batches" in captured.err
    assert sorted(tmp_path.iterdir()) == [output, media]
    rows = list(csv.DictReader(output.read_text().splitlines()))
    assert [row["name"] for row in rows] == [line[0] for line in MEDIA]
    assert all(float(row["converged"]) == 1 for row in rows)
    with jax.enable_x64(True):
        medium = sj.Medium(*(jnp.asarray([value]) for value in (0.03, 0.7, 1.2)))
        weights = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
        alone = sj.fit_gaussians(sj.Dipole(medium), 2, weights=weights)
        expected = [*alone.gaussians.variances, *alone.gaussians.weights[:, 0], alone.error[0]]
        columns = ("variance_1", "variance_2", "weight_1", "weight_2", "error")
        found = [float(rows[3][column]) for column in columns]
        np.testing.assert_allclose(found, np.asarray(expected), rtol=1e-6)


def test_it_reports_how_many_did_not_converge(media, tmp_path, monkeypatch, capsys):
    columns = {"error": np.zeros(5), "converged": np.asarray([1.0, 0.0, 1.0, 1.0, 0.0])}
    monkeypatch.setattr(_fit_all, "_fitted", lambda *_: columns)
    assert run("fit", media, "--all", "--output", tmp_path / "fits.csv") == 0
    assert "2 of 5 fits" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ([], "--output"),
        (["--output", "nowhere/fits.csv"], "no folder"),
        (["--output", "fits.csv", "--error", 0.1], "leave the other options out"),
        (["--output", "fits.csv", "--count", 9], "--count is 9"),
    ],
)
def test_options_that_all_media_cannot_have_are_refused(words, named, media, capsys, monkeypatch):
    monkeypatch.chdir(media.parent)
    assert named in failure(["fit", media, "--all", *words], capsys)
