"""The command line, run in process on tiny inputs."""

import itertools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
import trimesh
from commands import failure, plate, write_ply
from jax.experimental.compilation_cache import compilation_cache
from PIL import Image

import splatjax as sj
from splatjax.cli import main
from splatjax.cli._environment import cache_folder, prepare_jax
from splatjax.cli._render import Render
from splatjax.cli._shot import frame_all, towards
from splatjax.io import read_manifest

SKIN = """[medium]
unit = "1/mm"
sigma_a = [{sigma_a}, 0.17, 0.48]
sigma_s_prime = [0.74, 0.88, 1.01]
eta = 1.3
"""


def test_materials_lists_the_library(capsys):
    assert main(["materials"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]]
    assert listed == list(sj.list_materials())
    assert "skin" in listed


def test_materials_tells_what_is_known_and_who_published_it(capsys):
    assert main(["materials"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert re.search(r"skin +Gaussians .* d'Eon et al. 2007", lines["skin"])
    assert re.search(r"skin_layers +layers .* Donner et al. 2005", lines["skin_layers"])
    assert re.search(r"marble +coefficients .* Jensen et al. 2001", lines["marble"])


def test_materials_prints_the_file_of_one_to_begin_with(tmp_path, capsys):
    assert main(["materials", "marble"]) == 0
    mine = tmp_path / "mine.toml"
    mine.write_text(capsys.readouterr().out, encoding="utf-8")
    np.testing.assert_array_equal(
        sj.load_material(mine).gaussians.weights, sj.load_material("marble").gaussians.weights
    )
    assert "is no known material; did you mean 'marble'?" in failure(
        ["materials", "marbel"], capsys
    )


@pytest.mark.once
def test_fit_prints_and_writes_a_material_that_loads(tmp_path, capsys):
    output, plot = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert main(["fit", "skin1", "--count", "2", "--output", str(output), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    assert "error (Eq. 4)" in printed
    assert printed.splitlines()[-2:] == [str(output), str(plot)]
    with Image.open(plot) as picture:
        assert min(picture.size) > 400
    material, medium = sj.load_material(output), sj.load_medium("skin1")
    assert material.gaussians.weights.shape == (2, 3)
    total = sj.Dipole(medium).total_reflectance()
    np.testing.assert_allclose(
        np.asarray(material.gaussians.total_reflectance()), np.asarray(total), rtol=1e-5
    )


@pytest.mark.once
def test_fit_takes_a_table_and_the_least_count(tmp_path, capsys):
    table, output = tmp_path / "measured.csv", tmp_path / "measured.toml"
    r = np.linspace(0.01, 0.5, 40)
    np.savetxt(
        table,
        np.column_stack([r, np.exp(-((10 * r) ** 2) / 4)]),
        delimiter=",",
        header="r (cm), R (1/cm^2)",
    )
    command = ["fit", str(table), "--mm-per-unit", "10", "--error", "1e-4", "--output", str(output)]
    assert main(command) == 0
    assert "error (Eq. 4)" in capsys.readouterr().out
    gaussians = sj.load_material(output).gaussians
    np.testing.assert_allclose(gaussians.variances, [2.0], rtol=1e-5)
    np.testing.assert_allclose(gaussians.weights, [[4 * np.pi / 100]], rtol=1e-5)


@pytest.mark.once
@pytest.mark.parametrize(
    ("model", "said"),
    [
        ("better-dipole", "better dipole, exact"),
        ("photon-beam", "photon beam with"),
        ("monte-carlo", "Monte Carlo, 20000 photons"),
    ],
)
def test_fit_takes_the_model_that_is_asked_for(model, said, tmp_path, capsys):
    output = tmp_path / "skin.toml"
    command = [
        "fit",
        "skin1",
        "--model",
        model,
        "--photons",
        "20000",
        "--count",
        "3",
        "--output",
        str(output),
    ]
    assert main(command) == 0
    assert str(output) in capsys.readouterr().out
    assert said in output.read_text()
    total = np.asarray(sj.load_material(output).gaussians.total_reflectance())
    # What leaves skin, by Monte Carlo (MCML), and by how much each model misses it.
    np.testing.assert_allclose(
        total,
        [0.4395, 0.2133, 0.1155],
        rtol={"better-dipole": 0.12, "photon-beam": 0.1}.get(model, 0.05),
    )
    assert "this material has layers" in failure(
        ["fit", "skin_layers", "--model", "photon-beam"], capsys
    )


@pytest.mark.once
@pytest.mark.parametrize("model", ["photon-beam", "monte-carlo"])
def test_fit_keeps_single_scattering_apart(model, tmp_path, capsys):
    output = tmp_path / "skin.toml"
    command = [
        "fit",
        "skin1",
        "--model",
        model,
        "--single-scattering",
        "--photons",
        "20000",
        "--count",
        "3",
        "--output",
        str(output),
    ]
    assert main(command) == 0
    assert "without single scattering" in output.read_text()
    material = sj.load_material(output)
    single, rest = (
        np.asarray(each.total_reflectance())
        for each in (material.single_scattering, material.gaussians)
    )
    assert np.all((single > 0.03) & (single < rest))
    np.testing.assert_allclose(single + rest, [0.4395, 0.2133, 0.1155], rtol=0.1)
    capsys.readouterr()
    for more in (["skin1"], ["skin_layers", "--model", "monte-carlo"]):
        assert "--single-scattering" in failure(["fit", *more, "--single-scattering"], capsys)


@pytest.mark.once
def test_fit_takes_a_photograph_that_any_program_wrote(tmp_path, capsys):
    photograph, output = tmp_path / "dot.exr", tmp_path / "dot.toml"
    y, x = (np.mgrid[:60, :60] - 29.5) * 0.2
    radiance = 3 / np.pi * np.exp(-(x * x + y * y) / 4) / (4 * np.pi)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": radiance.astype(np.float32)}) as file:
        file.write(str(photograph))
    command = ["fit", str(photograph), "--count", "1", "--power", "3", "--output", str(output)]
    assert "how large is a pixel on the surface? give --mm-per-pixel" in failure(
        command, capsys, [output]
    )
    assert main([*command, "--mm-per-pixel", "0.2"]) == 0
    gaussians = sj.load_material(output).gaussians
    np.testing.assert_allclose(gaussians.variances, [2.0], rtol=0.01)
    np.testing.assert_allclose(gaussians.weights, [[1.0]], rtol=0.01)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            ["dot.csv", "--model", "monte-carlo"],
            "--model is for coefficients, and dot.csv is taken for a measured profile",
        ),
        (
            ["dot.exr", "--mm-per-pixel", "1", "--single-scattering"],
            "--single-scattering is for coefficients, and dot.exr",
        ),
        (
            ["dot.csv", "--power", "2"],
            "--power is for a photograph, and dot.csv is taken for a measured profile",
        ),
        (
            ["marble", "--mm-per-unit", "10"],
            "--mm-per-unit is for a measured profile, and marble is taken for coefficients",
        ),
        (["marble", "--count", "13"], "--count is 13; it lies between 1 and 12"),
    ],
)
def test_fit_refuses_what_has_no_effect(command, said, capsys):
    assert said in failure(["fit", *command], capsys)


@pytest.mark.once
def test_fit_tells_of_more_light_than_is_given(tmp_path, capsys):
    path = tmp_path / "bright.csv"
    path.write_text("r (mm), R\n0.5, 0.42\n1, 0.19\n2, 0.048\n4, 0.0062\n")
    assert main(["fit", str(path), "--count", "1"]) == 0
    assert re.search(
        r"bright\.csv sends back [1-9][0-9.]* times the light it is given", capsys.readouterr().err
    )


@pytest.mark.once
def test_fit_tells_of_radii_too_few_for_its_gaussians(tmp_path, capsys):
    path = tmp_path / "few.csv"
    path.write_text("r (mm), R\n0.5, 0.084\n1, 0.037\n2, 0.0096\n4, 0.00124\n8, 0.000084\n")
    assert main(["fit", str(path), "--count", "2"]) == 0
    assert "too few" not in capsys.readouterr().err
    main(["fit", str(path), "--count", "3"])
    assert (
        "few.csv has 5 radii, too few to tell 3 Gaussians apart: give a smaller --count"
        in capsys.readouterr().err
    )


def test_a_small_body_is_framed_as_a_large_one(tmp_path):
    body = plate(tmp_path / "plate.ply")
    large, small = (
        Render(splats=body, output=tmp_path / "o.exr", scale=scale) for scale in (1.0, 0.2)
    )
    ours, theirs = large.splats_to_show(), small.splats_to_show()
    np.testing.assert_allclose(theirs.centers, 0.2 * ours.centers, rtol=1e-6)
    np.testing.assert_allclose(theirs.areas.sum(), 0.04 * ours.areas.sum(), rtol=1e-5)
    np.testing.assert_allclose(
        small.camera(theirs, 25.0).position, 0.2 * large.camera(ours, 25.0).position, rtol=1e-5
    )
    np.testing.assert_allclose(
        small.camera(theirs, 25.0).rotation, large.camera(ours, 25.0).rotation, atol=1e-6
    )


def test_a_mesh_is_no_cloud_of_splats(tmp_path, capsys):
    mesh = tmp_path / "ball.obj"
    trimesh.creation.icosphere().export(mesh)
    said = failure(["render", str(mesh), "--output", str(tmp_path / "o.exr")], capsys)
    assert (
        f"ball.obj: is a mesh; cover it with splats first: `splatjax sample {mesh} --mm-per-unit "
        "... --output ...`" in said
    )


def test_export_writes_what_other_renderers_take(tmp_path, capsys):
    output = tmp_path / "skin.json"
    assert main(["export", "skin", "--output", str(output)]) == 0
    assert capsys.readouterr().out == f"{output}\n"
    assert set(json.loads(output.read_text())) >= {
        "gpu_gems",
        "separable_kernel",
        "burley",
        "unity",
        "blender",
    }
    assert "must end in .json" in failure(["export", "skin", "--output", "skin.txt"], capsys)


def test_sample_covers_a_mesh(tmp_path, capsys):
    mesh, output = tmp_path / "square.obj", tmp_path / "square.ply"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    command = [
        "sample",
        str(mesh),
        "--mm-per-unit",
        "10",
        "--count",
        "50",
        "--crop-min-y",
        "0.5",
        "--output",
        str(output),
    ]
    assert main(command) == 0
    splats = sj.read_splats(output)
    assert splats.count == 50
    np.testing.assert_allclose(float(jnp.sum(splats.areas)), 50.0, rtol=1e-3)
    assert float(jnp.min(splats.centers[:, 1])) >= 5 - 1e-4
    assert "50 mm^2" in capsys.readouterr().err


def test_files_with_z_up_and_the_crease_angle(tmp_path):
    """A box that is tall along z stands upright; its edges are hard up to an angle."""
    mesh, output = tmp_path / "box.stl", tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 9)).export(mesh)
    command = ["sample", str(mesh), "--mm-per-unit", "1", "--count", "400", "--output", str(output)]
    largest = []
    for options in (["--crease-angle", "91"], ["--up", "z"]):
        assert main([*command, *options]) == 0
        largest.append(np.abs(np.asarray(sj.read_splats(output).normals)).max(axis=1))
    assert np.median(largest[0]) < 0.95
    np.testing.assert_allclose(largest[1], 1, atol=1e-6)
    assert np.ptp(np.asarray(sj.read_splats(output).centers), axis=0).argmax() == 1
    lying = Render(splats=output, up="z", output=tmp_path / "box.exr").splats_to_show()
    assert np.ptp(np.asarray(lying.centers), axis=0).argmax() == 2


@pytest.mark.slow
@pytest.mark.once
def test_render_shows_the_bust_and_says_what_it_does(tmp_path, capsys):
    output = tmp_path / "bust.exr"
    assert (
        main(
            [
                "render",
                "--count",
                "5000",
                "--width",
                "64",
                "--height",
                "64",
                "--output",
                str(output),
            ]
        )
        == 0
    )
    captured = capsys.readouterr()
    picture = output.with_suffix(".png")
    assert captured.out.splitlines() == [str(output), str(picture)]
    assert "only spreads the light" in captured.err
    frame = sj.read_exr(output)
    np.testing.assert_allclose(np.sum(np.asarray(frame.weights), axis=0), 1.0, rtol=1e-5)
    assert 0.1 < np.mean(np.asarray(frame.coverage)) < 0.9
    # What stands in the picture makes the picture again, bit by bit.
    manifest = read_manifest(output)
    material, again = tmp_path / "again.toml", tmp_path / "again.exr"
    material.write_text(manifest["contents of --material"], encoding="utf-8")
    options = [
        f"{name}={value}"
        for name, value in manifest.items()
        if name[:2] == "--" and name not in ("--material", "--scattering", "--albedo")
    ]
    assert main(["render", *options, "--material", str(material), "--output", str(again)]) == 0
    for name, value in vars(sj.read_exr(again)).items():
        np.testing.assert_array_equal(
            np.asarray(value), np.asarray(getattr(frame, name)), err_msg=name
        )
    with Image.open(picture) as shown:
        assert shown.size == (64, 64)
        assert np.asarray(shown).max() > 100


@pytest.mark.slow
@pytest.mark.once
def test_turntable_of_the_bust_is_one_program(tmp_path, drawn):
    size = (
        "--count",
        "5000",
        "--width",
        "64",
        "--height",
        "64",
    )  # as above: it need not be compiled again
    assert (
        main(
            [
                "turntable",
                *size,
                "--frames",
                "3",
                "--degrees",
                "0.3",
                "--output",
                str(tmp_path / "turn"),
            ]
        )
        == 0
    )
    assert len({(id(plan), compiled) for plan, compiled in drawn}) == 1
    pictures = [
        np.asarray(sj.read_exr(tmp_path / "turn" / f"frame_{i:04}.exr").beauty) for i in range(3)
    ]
    for one, other in itertools.pairwise(pictures):
        assert 0 < np.abs(one - other).mean() < 1e-2


def test_color_is_of_the_albedo_or_of_the_material(tmp_path, capsys):
    path = tmp_path / "painted.ply"
    bare, total = (
        sj.read_splats(plate(path)),
        np.asarray(sj.load_material("marble").gaussians.total_reflectance()),
    )
    sj.write_splats(
        path,
        sj.Splats(
            bare.centers, bare.normals, bare.radii, bare.areas, jnp.full_like(bare.centers, 0.5)
        ),
    )
    for worn, weight in ((True, np.ones(3)), (False, total)):
        splats, material = Render(splats=path, material="marble", albedo=worn).load()
        assert (splats.albedo is not None) == worn
        np.testing.assert_allclose(
            np.asarray(material.gaussians.total_reflectance()), weight, rtol=1e-5
        )
        assert ("only spreads the light" in capsys.readouterr().err) == worn


@pytest.mark.slow
@pytest.mark.once
def test_render_without_scattering_is_lambertian(tmp_path, capsys):
    splats, output = plate(tmp_path / "plate.ply"), tmp_path / "plate.exr"
    view = [
        "--width",
        "32",
        "--height",
        "32",
        "--azimuth",
        "0",
        "--light-azimuth",
        "0",
        "--light-elevation",
        "60",
        "--fill",
        "0",
    ]
    command = [
        "render",
        str(splats),
        "--material",
        "marble",
        "--no-scattering",
        *view,
        "--output",
        str(output),
    ]
    assert main(command) == 0
    assert "albedo" not in capsys.readouterr().err
    frame = sj.read_exr(output)
    total = np.asarray(sj.load_material("marble").gaussians.total_reflectance())
    middle = np.asarray(frame.diffuse)[16, 16]
    # radiance = reflectance x irradiance / pi, with irradiance pi cos 60 degrees; the interface
    # takes and gives a few per cent
    np.testing.assert_allclose(middle, 0.5 * total, rtol=0.03)
    np.testing.assert_allclose(np.asarray(frame.weights), total[None], rtol=1e-5)


XYZ = ("x", "y", "z")
BAD_SPLATS = {
    "empty": ([], XYZ, "no rows"),
    "nan": ([(0, 0, 0), (1, "nan", 0)], XYZ, "1 nan 0"),
    "zero radius": ([(0, 0, 0, 0), (1, 0, 0, 1)], (*XYZ, "radius"), "positive"),
    "negative radius": ([(0, 0, 0, -1), (1, 0, 0, 1)], (*XYZ, "radius"), "positive"),
}


@pytest.mark.parametrize("kind", BAD_SPLATS)
def test_bad_splats_are_one_line(kind, tmp_path, capsys):
    rows, names, said = BAD_SPLATS[kind]
    splats, output = write_ply(tmp_path / "bad.ply", rows, names), tmp_path / "out.exr"
    line = failure(
        ["render", splats, "--output", output], capsys, [output, output.with_suffix(".png")]
    )
    assert str(splats) in line
    assert said in line


@pytest.mark.parametrize("command", ["render", "sample", "fit"])
def test_missing_input_is_one_line(command, tmp_path, capsys):
    absent = tmp_path / {"render": "no.ply", "sample": "no.glb", "fit": "no.toml"}[command]
    output = tmp_path / {"render": "o.exr", "sample": "o.ply", "fit": "o.toml"}[command]
    more = ["--mm-per-unit", "1"] if command == "sample" else []
    assert absent.name in failure([command, absent, *more, "--output", output], capsys, [output])


def test_unknown_material_is_one_line(tmp_path, capsys):
    output = tmp_path / "o.exr"
    assert "marbel" in failure(
        ["render", "--material", "marbel", "--output", output], capsys, [output]
    )
    assert "marbel" in failure(["fit", "marbel"], capsys)


@pytest.mark.parametrize("command", ["render", "fit"])
def test_negative_coefficient_is_one_line(command, tmp_path, capsys):
    material = tmp_path / "bad.toml"
    material.write_text(SKIN.format(sigma_a=-0.03))
    output = tmp_path / {"render": "o.exr", "fit": "o.toml"}[command]
    given = ["--material", material] if command == "render" else [material]
    line = failure([command, *given, "--output", output], capsys, [output])
    assert "bad.toml" in line
    assert "sigma_a" in line


def test_outputs_are_refused_before_the_work(tmp_path, capsys):
    assert "no folder" in failure(["render", "--output", tmp_path / "none" / "o.exr"], capsys)
    assert ".exr" in failure(["render", "--output", tmp_path / "o.png"], capsys)
    assert ".toml" in failure(["fit", "skin1", "--output", tmp_path / "o.txt"], capsys)


@pytest.mark.parametrize(
    ("option", "value"),
    [("elevation", 90), ("fov", 180), ("fov", -5), ("width", 0), ("height", -3), ("fill", -1)],
)
def test_impossible_cameras_are_one_line(option, value, tmp_path, capsys):
    splats, output = plate(tmp_path / "plate.ply"), tmp_path / "o.exr"
    args = ["render", splats, "--material", "marble", f"--{option}", value, "--output", output]
    status = main([str(word) for word in args])
    lines = capsys.readouterr().err.splitlines()
    assert status == 2
    assert sum(line.startswith("splatjax: ") for line in lines) == 1
    assert option in lines[-1]
    assert not output.exists()


def test_a_word_too_many_exits_with_two(capsys):
    with pytest.raises(SystemExit) as left:
        main(["render", "--no-such-option"])
    assert left.value.code == 2
    assert "no-such-option" in capsys.readouterr().err


@pytest.mark.parametrize(("width", "height"), [(64, 64), (128, 64), (64, 128)])
def test_camera_frames_the_bounding_sphere(width, height, dtype):
    places = np.random.default_rng(3).normal(size=(500, 3))
    places = 40 * places / np.linalg.norm(places, axis=1, keepdims=True) + np.asarray(
        [5.0, -20.0, 3.0]
    )
    count = len(places)
    centers = jnp.asarray(places, dtype)
    ones = jnp.ones(count, dtype)
    splats = sj.Splats(
        centers, jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], dtype), (count, 3)), ones, ones
    )
    camera = frame_all(splats, towards(30.0, 20.0), 25.0, width, height)
    local = np.asarray((centers - camera.position[None]) @ camera.rotation.T)
    x = local[:, 0] / local[:, 2] * float(camera.focal_length) * height / width
    y = local[:, 1] / local[:, 2] * float(camera.focal_length)
    reach = max(np.abs(x).max(), np.abs(y).max())
    assert 0.4 < reach < 0.5


def test_azimuth_turns_from_the_front_to_the_side():
    np.testing.assert_allclose(np.asarray(towards(0.0, 0.0)), [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(np.asarray(towards(90.0, 0.0)), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(np.asarray(towards(0.0, 30.0)), [0, 0.5, np.sqrt(0.75)], atol=1e-6)


def test_cache_folder_follows_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    jax.config.update("jax_compilation_cache_dir", None)
    prepare_jax()
    folder = tmp_path / "cache" / "splatjax" / "jax"
    assert (
        Path(jax.config.jax_compilation_cache_dir).parent == folder
    )  # in it a folder for this kind of processor
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder().is_absolute()
    assert cache_folder().parts[-4:-1] == (".cache", "splatjax", "jax")


def test_what_was_compiled_is_taken_from_the_cache_in_silence(tmp_path, monkeypatch, capfd):
    """XLA calls an error whatever it takes from there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    prepare_jax()
    compilation_cache.reset_cache()
    events = []
    jax.monitoring.register_event_listener(listener := lambda event, **_: events.append(event))
    x = jnp.ones(9)
    for hits in (0, 1):
        jax.jit(lambda x: jnp.cumsum(jnp.sin(x)))(
            x
        ).block_until_ready()  # a new function, of the same program
        assert events.count("/jax/compilation_cache/cache_hits") == hits
    jax.monitoring.unregister_event_listener(listener)
    assert capfd.readouterr().err == ""
