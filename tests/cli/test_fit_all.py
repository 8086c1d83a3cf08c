"""Many media by one command, into one table."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import failure

import splatjax as sj
from splatjax.cli import _fit_all, main

pytestmark = pytest.mark.once

MEDIA = [
    ("a", 0.002, 2.6, 1.5),
    ("b", 0.5, 1.0, 1.3),
    ("c", 0.0, 3.0, 1.4),
    ("d", 0.03, 0.7, 1.2),
    ("e", 0.1, 8.0, 1.0),
]


@pytest.fixture
def media(tmp_path):
    lines = ["name,sigma_a,sigma_s_prime,eta", *(",".join(map(str, row)) for row in MEDIA)]
    (tmp_path / "media.csv").write_text("\n".join(lines) + "\n")
    return tmp_path / "media.csv"


def test_a_table_of_media_becomes_a_table_of_fits_and_is_taken_up_again(
    media, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(_fit_all, "_TOGETHER", 2)
    words = ["fit", str(media), "--all", "--count", "2", "--output", str(tmp_path / "fits.csv")]
    write_columns, written = _fit_all.write_columns, []

    def interrupted(path, columns):
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path)
        write_columns(path, columns)

    monkeypatch.setattr(_fit_all, "write_columns", interrupted)
    assert main(words) == 130
    assert not (tmp_path / "fits.csv").exists()
    monkeypatch.setattr(_fit_all, "write_columns", write_columns)
    capsys.readouterr()
    assert main(words) == 0
    said = capsys.readouterr()
    assert said.out == f"{tmp_path / 'fits.csv'}\n"
    assert "2 of 3 batches are there already" in said.err
    assert "all 5 fits converged" in said.err
    assert not (tmp_path / "fits.csv.parts").exists()
    rows = list(csv.DictReader((tmp_path / "fits.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == [name for name, *_ in MEDIA]
    assert all(float(row["converged"]) == 1 for row in rows)
    with jax.enable_x64(True):
        alone = sj.fit_gaussians(
            sj.Dipole(sj.Medium(*(jnp.asarray([value]) for value in MEDIA[3][1:]))),
            2,
            weights=sj.NonNegativeWeights(sj.FixedTotalReflectance()),
        )
        np.testing.assert_allclose(
            [float(rows[3][f"variance_{i}"]) for i in (1, 2)], alone.gaussians.variances, rtol=1e-6
        )
        np.testing.assert_allclose(
            [float(rows[3][f"weight_{i}"]) for i in (1, 2)],
            alone.gaussians.weights[:, 0],
            rtol=1e-6,
        )
        np.testing.assert_allclose(float(rows[3]["error"]), alone.error[0], rtol=1e-6)


def test_it_says_how_many_did_not_converge(media, tmp_path, monkeypatch, capsys):
    def fitted(coefficients, count, weights):
        return {
            "error": np.zeros(len(coefficients)),
            "converged": np.asarray([1.0, 0.0, 1.0, 1.0, 0.0]),
        }

    monkeypatch.setattr(_fit_all, "_fitted", fitted)
    assert main(["fit", str(media), "--all", "--output", str(tmp_path / "fits.csv")]) == 0
    assert "2 of 5 fits did not converge; in their rows `converged` is 0" in capsys.readouterr().err


BAD = {
    "": "its first line has no sigma_a",
    "sigma_a,sigma_s_prime,eta\n": "holds no medium",
    "sigma_a,sigma_s_prime,eta\n1,2\n": "medium 1 has 2 cells",
    "sigma_a,sigma_s_prime,eta\n1,0,1.3\n": "sigma_s_prime of medium 1 is '0'; it must be positive",
    "sigma_a,sigma_s_prime,eta\n1,1,1.3\n-1,1,1.3\n": (
        "sigma_a of medium 2 is '-1'; it must be 0 or more"
    ),
    "sigma_a,sigma_s_prime,eta\n1,1,glass\n": "eta of medium 1 is 'glass'",
}


@pytest.mark.parametrize("text", BAD)
def test_a_table_that_is_none_is_one_line(text, tmp_path, capsys):
    (tmp_path / "media.csv").write_text(text)
    output = tmp_path / "fits.csv"
    said = failure(["fit", tmp_path / "media.csv", "--all", "--output", output], capsys, [output])
    assert "media.csv: " in said
    assert BAD[text] in said


def test_options_that_all_media_cannot_have_are_refused(media, tmp_path, capsys):
    assert "needs --output" in failure(["fit", media, "--all"], capsys)
    output = tmp_path / "fits.csv"
    assert "leave the other options out" in failure(
        ["fit", media, "--all", "--output", output, "--error", 0.1], capsys, [output]
    )
    assert "between 1 and 8" in failure(
        ["fit", media, "--all", "--output", output, "--count", 9], capsys, [output]
    )
