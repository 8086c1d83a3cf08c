"""`splatjax fit` of coefficients, tables and photographs."""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import optimistix as optx
import pytest
from commands import failure, run
from PIL import Image

import splatjax as sj
from splatjax.cli import _models

SKIN = [0.4395, 0.2133, 0.1155]  # what leaves skin1, by Monte Carlo (MCML)
OWN = """[medium]
unit = "1/mm"
sigma_a = [0.0021, 0.0041, 0.0071]
sigma_s_prime = [2.19, 2.62, 3.0]
eta = 1.5
[surface]
roughness = 0.11
specular = 0.07
[source]
citation = "measured by hand"
provenance = "the third sample"
"""


def reflectance(path):
    return np.asarray(sj.load_material(path).gaussians.total_reflectance())


@pytest.mark.once
def test_it_prints_and_writes_a_material_that_loads(tmp_path, capsys):
    output, plot = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert run("fit", "skin1", "--count", "2", "--output", output, "--plot", plot) == 0
    printed = capsys.readouterr().out
    assert "error (Eq. 4)" in printed
    assert printed.splitlines()[-2:] == [str(output), str(plot)]
    with Image.open(plot) as picture:
        assert min(picture.size) > 400
    assert sj.load_material(output).gaussians.weights.shape == (2, 3)
    total = np.asarray(sj.Dipole(sj.load_medium("skin1")).total_reflectance())
    np.testing.assert_allclose(reflectance(output), total, rtol=1e-5)


@pytest.mark.once
@pytest.mark.parametrize(
    ("words", "description", "rtol"),
    [
        ("--model better-dipole", "better dipole, exact", 0.12),
        ("--model photon-beam --single-scattering", "without single scattering", 0.1),
        pytest.param("--model photon-beam", "photon beam with", 0.1, marks=pytest.mark.long),
        pytest.param(
            "--model monte-carlo --photons 20000",
            "Monte Carlo, 20000 photons",
            0.05,
            marks=pytest.mark.long,
        ),
        pytest.param(
            "--model monte-carlo --photons 20000 --single-scattering",
            "without single scattering",
            0.05,
            marks=pytest.mark.long,
        ),
    ],
)
def test_it_takes_the_model_that_is_asked_for(words, description, rtol, tmp_path):
    output = tmp_path / "skin.toml"
    assert run("fit", "skin1", *words.split(), "--count", 3, "--output", output) == 0
    assert description in output.read_text()
    material, total = sj.load_material(output), reflectance(output)
    if material.single_scattering is not None:
        single = np.asarray(material.single_scattering.total_reflectance())
        assert np.all((single > 0.03) & (single < total))
        total = total + single
    np.testing.assert_allclose(total, SKIN, rtol=rtol)


@pytest.mark.once
def test_it_takes_a_table_and_the_least_count(tmp_path):
    table, output = tmp_path / "measured.csv", tmp_path / "measured.toml"
    r = np.linspace(0.01, 0.5, 40)
    rows = np.column_stack([r, np.exp(-((10 * r) ** 2) / 4)])
    np.savetxt(table, rows, delimiter=",", header="r (cm), R (1/cm^2)")
    assert run("fit", table, "--mm-per-unit", 10, "--error", "1e-4", "--output", output) == 0
    gaussians = sj.load_material(output).gaussians
    np.testing.assert_allclose(gaussians.variances, [2.0], rtol=1e-5)
    np.testing.assert_allclose(gaussians.weights, [[4 * np.pi / 100]], rtol=1e-5)


@pytest.mark.once
def test_it_takes_a_photograph_and_the_size_of_its_pixels(tmp_path, capsys):
    photograph, output = tmp_path / "dot.exr", tmp_path / "dot.toml"
    y, x = (np.mgrid[:60, :60] - 29.5) * 0.2
    radiance = 3 / np.pi * np.exp(-(x * x + y * y) / 4) / (4 * np.pi)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": radiance.astype(np.float32)}) as file:
        file.write(str(photograph))
    command = ["fit", photograph, "--count", 1, "--power", 3, "--output", output]
    assert "--mm-per-pixel" in failure(command, capsys)
    assert run(*command, "--mm-per-pixel", 0.2) == 0
    gaussians = sj.load_material(output).gaussians
    np.testing.assert_allclose(gaussians.variances, [2.0], rtol=0.01)
    np.testing.assert_allclose(gaussians.weights, [[1.0]], rtol=0.01)


@pytest.mark.once
@pytest.mark.parametrize(
    ("values", "count", "noted"),
    [
        ((0.42, 0.19, 0.048, 0.0062), 1, "times the light"),
        ((0.084, 0.037, 0.0096, 0.00124), 2, None),
        ((0.084, 0.037, 0.0096, 0.00124), 3, "4 radii"),
    ],
)
def test_it_notes_too_much_light_and_too_few_radii(values, count, noted, tmp_path, capsys):
    rows = zip((0.5, 1, 2, 4), values, strict=True)
    lines = ["r (mm), R", *(f"{r}, {value}" for r, value in rows)]
    (tmp_path / "few.csv").write_text("\n".join(lines))
    run("fit", tmp_path / "few.csv", "--count", count)
    notes = [line for line in capsys.readouterr().err.splitlines() if "few.csv " in line]
    assert (noted is None and not notes) or any(noted in line for line in notes)


@pytest.mark.parametrize(
    ("words", "remedy"), [("", "--count"), ("--model monte-carlo --photons 200", "--photons")]
)
def test_a_fit_that_does_not_settle_names_the_remedy(words, remedy, monkeypatch, tmp_path, capsys):
    def unsettled(profile, count, **_):
        gaussians = sj.SumOfGaussians(jnp.ones(count), jnp.ones((count, 3)))
        result = optx.RESULTS.nonlinear_max_steps_reached
        return sj.fitting.FitResult(gaussians, jnp.ones(3), jnp.ones(3), result, jnp.eye(4 * count))

    walked = sj.scattering.Tabulated(
        jnp.arange(1.0, 5.0), jnp.ones((4, 3)), jnp.ones((4, 3)), jnp.ones(3)
    )
    monkeypatch.setattr(sj, "fit_gaussians", unsettled)
    monkeypatch.setattr(_models, "_walked", lambda *_: _models.Reference(walked))
    output = tmp_path / "mine.toml"
    line = failure(["fit", "skin1", *words.split(), "--output", output], capsys)
    assert "skin1" in line
    assert remedy in line
    assert not output.exists()


@pytest.mark.once
def test_a_fit_to_its_own_file_keeps_what_stood_there(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    assert run("fit", path, "--count", 1, "--output", path) == 0
    after = tomllib.loads(path.read_text())
    assert after["medium"]["sigma_a"] == tomllib.loads(OWN)["medium"]["sigma_a"]
    assert after["surface"] == {"eta": 1.5, "specular": 0.07, "roughness": 0.11}
    assert after["source"]["citation"] == "measured by hand"
    assert after["source"]["provenance"].startswith("the third sample; fitted by splatjax")
    assert len(after["fit"]["variances"]) == 1
    with jax.enable_x64(True):
        assert run("fit", path, "--count", 1, "--output", path) == 0
    assert tomllib.loads(path.read_text())["surface"] == after["surface"]
