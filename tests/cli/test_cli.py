"""The other commands, run in process on tiny inputs; of `splatjax recover` its inputs, options,
messages and files: the search itself is tested where it is.
"""

import re
import tomllib
from pathlib import Path

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import trimesh
from commands import plate, run
from jax.experimental.compilation_cache import compilation_cache
from pictures import write_picture
from PIL import Image

import splatjax as sj
from splatjax.cli._main import prepare_jax
from splatjax.cli._render import Render
from splatjax.cli._scene import note_unresolved
from splatjax.cli._view import direction_to

SMALL = ["--count", "400", "--width", "32", "--height", "32", "--light-azimuth", "-20"]
LISTED = {
    "skin": r"Gaussians .* d'Eon et al. 2007",
    "skin_layers": r"layers .* Donner et al. 2005",
    "marble": r"coefficients .* Jensen et al. 2001",
}


def test_materials_lists_the_library_with_its_sources_and_prints_a_file(tmp_path, capsys):
    assert run("materials") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()[1:]}
    assert list(lines) == list(sj.list_materials())
    assert [name for name, source in LISTED.items() if not re.search(source, lines[name])] == []
    assert run("materials", "marble") == 0
    mine = tmp_path / "mine.toml"
    mine.write_text(capsys.readouterr().out, encoding="utf-8")
    assert eqx.tree_equal(sj.load_material(mine), sj.load_material("marble"))


def test_export_writes_what_other_renderers_take(tmp_path, capsys):
    output = tmp_path / "skin.json"
    assert run("export", "skin", "--output", output) == 0
    assert capsys.readouterr().out == f"{output}\n"
    variances = [0.0064, 0.0484, 0.187, 0.567, 1.99, 7.41]
    np.testing.assert_allclose(sj.io.read_record(output)["gaussians"]["variances"], variances)
    mine, output = tmp_path / "mine.toml", tmp_path / "mine.mtlx"
    marble = sj.io.material_path("marble").read_text(encoding="utf-8")
    mine.write_text(marble.replace("[medium]", "[medium]\ng = 0.5"), encoding="utf-8")
    assert run("export", mine, "--output", output) == 0
    assert 'anisotropy" type="float" value="0.5"' in output.read_text(encoding="utf-8")


def test_export_of_coefficients_needs_no_fit(tmp_path):
    """And gives the same as with it."""
    text = sj.io.material_path("marble").read_text(encoding="utf-8")
    for name, part in (("unfitted", text.partition("[fit]")[0]), ("fitted", text)):
        (tmp_path / f"{name}.toml").write_text(part, encoding="utf-8")
        output = tmp_path / f"{name}.mtlx"
        assert run("export", tmp_path / f"{name}.toml", "--output", output) == 0
    assert (tmp_path / "unfitted.mtlx").read_text() == (tmp_path / "fitted.mtlx").read_text()


OF_MESH = {"mesh": "box.stl", "mm_per_unit": 10, "up": "z", "scale": 2, "count": 50}
EXPORTED = """material = "skin"
camera = { position = [0, 0, 620], target = [0, 0, 0], fov = 25 }
lights = [{ kind = "directional", direction = [0, -1, 0], irradiance = 1.0 }]
"""


@pytest.mark.parametrize(
    ("splats", "height"), [(OF_MESH, 0.18), ({"bust": 50, "scale": 0.1}, 0.0327)]
)
def test_export_writes_a_scene_with_its_mesh(splats, height, tmp_path):
    """Which bounds the body: the mesh of the file in its unit, or that of the bust, scaled."""
    trimesh.creation.box((1, 1, 9)).export(tmp_path / "box.stl")
    sj.io.write_toml(tmp_path / "it.toml", tomllib.loads(EXPORTED) | {"splats": splats})
    assert run("export", tmp_path / "it.toml", "--output", tmp_path / "it.glb") == 0
    written = trimesh.load_mesh(tmp_path / "it.glb")
    written.merge_vertices(merge_norm=True)
    assert written.extents[1] == pytest.approx(height, rel=2e-3)
    assert written.is_watertight


def test_export_notes_that_splats_are_no_closed_body(tmp_path, capsys):
    plate(tmp_path / "plate.ply")
    for splats, is_noted in (({"file": "plate.ply"}, True), ({"bust": 50}, False)):
        sj.io.write_toml(tmp_path / "it.toml", tomllib.loads(EXPORTED) | {"splats": splats})
        assert run("export", tmp_path / "it.toml", "--output", tmp_path / "it.glb") == 0
        assert ("`mesh`" in capsys.readouterr().err) == is_noted


def test_sample_covers_a_mesh_that_may_have_z_up(tmp_path, capsys):
    """A box that is tall along z stands upright; its edges are hard up to an angle."""
    mesh, output = tmp_path / "box.stl", tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 9)).export(mesh)
    command = ["sample", mesh, "--mm-per-unit", "2", "--count", "400", "--output", output]
    assert run(*command, "--crease-angle", "91", "--crop-min-y", "0") == 0
    cropped = sj.read_splats(output)
    assert np.median(np.abs(np.asarray(cropped.normals)).max(axis=1)) < 0.95
    assert float(jnp.min(cropped.centers[:, 1])) >= -1e-4
    assert "box.stl: its surface is open" in capsys.readouterr().err
    assert run(*command, "--up", "z") == 0
    noted = capsys.readouterr().err
    assert "400 splats on 152 mm^2, with no maps" in noted
    assert "its surface is open" not in noted
    upright = sj.read_splats(output)
    np.testing.assert_allclose(np.abs(np.asarray(upright.normals)).max(axis=1), 1, atol=1e-6)
    assert np.ptp(np.asarray(upright.centers), axis=0).argmax() == 1
    lying, _ = Render(splats=output, up="z").load()
    assert np.ptp(np.asarray(lying.centers), axis=0).argmax() == 2


@pytest.mark.long
def test_materials_draws_all_of_them_on_one_sheet(monkeypatch, tmp_path):
    """Ketchup is red and milk white; the other six places stay white."""
    monkeypatch.setattr(sj, "list_materials", lambda: ("ketchup", "wholemilk"))
    assert run("materials", "--pictures", tmp_path / "sheet.png") == 0
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"), float)[..., :3]
    row, steps = int(0.6 * len(sheet)), (np.arange(8) + 0.5) * sheet.shape[1] / 8
    places = [sheet[row - 4 : row + 5, at - 4 : at + 5].mean((0, 1)) for at in steps.astype(int)]
    assert places[0][0] > 3 * places[0][1]
    assert places[1].min() > 100
    assert min(place.min() for place in places[2:]) == 255


def test_sample_reads_the_share_of_another_material_from_a_map(tmp_path):
    """Skin that is dark where the map is white, on the right half of a square."""
    mesh, output, spots = tmp_path / "a.obj", tmp_path / "a.ply", tmp_path / "spots.png"
    lines = [f"v {x} {y} 0\nvt {x} {y}" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    mesh.write_text("\n".join([*lines, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4\n"]), encoding="utf-8")
    Image.fromarray(np.uint8([[0] * 8 + [255] * 8] * 4)).save(spots)
    given = "--mm-per-unit", "40", "--count", "300", "--share", spots, "--second", "skin_dark"
    assert run("sample", mesh, *given, "--output", output) == 0
    splats = sj.read_splats(output)
    x = np.asarray(splats.centers)[:, 0]
    light, dark = (sj.load_material(f"skin_{name}").gaussians for name in ("light", "dark"))
    np.testing.assert_array_equal(splats.weights[(x > 3) & (x < 17)], 1.0)
    totals = (np.asarray(light.weights)[None] * splats.weights[(x > 23) & (x < 37)]).sum(1)
    np.testing.assert_allclose(totals - dark.total_reflectance()[None], 0, atol=1e-4)


@pytest.mark.slow
def test_render_shows_the_bust_and_its_manifest_makes_the_same_picture(plain, tmp_path, capsys):
    output, picture = tmp_path / "bust.exr", tmp_path / "bust.png"
    assert run("render", *SMALL, "--output", output) == 0
    assert capsys.readouterr().out.splitlines() == [str(output), str(picture)]
    frame, manifest = sj.read_exr(output), sj.io.read_manifest(output)
    np.testing.assert_allclose(np.sum(np.asarray(frame.weights), axis=0), 1.0, rtol=1e-5)
    assert 0.1 < np.mean(np.asarray(frame.coverage)) < 0.9
    with Image.open(picture) as shown:
        assert shown.size == (32, 32)
        assert np.asarray(shown).max() > 100
    material, again, third = (tmp_path / name for name in ("again.toml", "again.exr", "third.exr"))
    material.write_text(manifest["contents of --material"], encoding="utf-8")
    flags = "--material", "--scattering", "--albedo"
    options = [f"{k}={v}" for k, v in manifest.items() if k[:2] == "--" and k not in flags]
    assert run("render", *options, "--material", material, "--output", again) == 0
    assert run("render", again, "--output", third) == 0
    for picture in map(sj.read_exr, (again, third)):
        assert eqx.tree_equal(picture, frame)


def test_the_number_of_splats_that_would_resolve_a_layer_is_noted(capsys):
    """With the number that is noted, about half of the layer is resolved."""
    material = sj.Material(sj.SumOfGaussians([4.0, 40.0], [[0.5], [0.5]]), eta=1.0)
    light, camera = sj.DirectionalLight([0, 0, -1], 3.0), bodies.view((0.0, 0.0, 80.0), size=24)

    def fraction(count):
        scene = sj.Scene(bodies.sphere(count, 20.0, jitter=1.0), light, material)
        frame = sj.render(scene, camera, bodies.PLAIN)
        note_unresolved(frame, scene, bodies.PLAIN.kernel, "--count", count)
        return float(frame.unresolved_fraction[0])

    assert fraction(800) > 0.9
    (needed,) = re.findall(r"of standard deviations 2 mm; about ([\d,]+) ", capsys.readouterr().err)
    assert fraction(int(needed.replace(",", ""))) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("albedo", [True, False])
def test_color_is_of_the_albedo_or_of_the_material(albedo, tmp_path, capsys):
    path = tmp_path / "painted.ply"
    bare = sj.read_splats(plate(path))
    sj.write_splats(path, bodies.with_albedo(bare, jnp.full_like(bare.centers, 0.5)))
    splats, material = Render(splats=path, material="marble", albedo=albedo).load()
    assert (splats.albedo is not None) == albedo
    total = 1.0 if albedo else sj.load_material("marble").gaussians.total_reflectance()
    np.testing.assert_allclose(material.gaussians.total_reflectance(), total, rtol=1e-5)
    assert ("--no-albedo" in capsys.readouterr().err) == albedo


@pytest.mark.parametrize(("albedo", "named"), [(True, "only spreads"), (False, "skin_light")])
def test_a_white_material_is_no_color(albedo, named, tmp_path, capsys):
    path = tmp_path / "painted.ply"
    bare = sj.read_splats(plate(path))
    sj.write_splats(path, bodies.with_albedo(bare, jnp.full_like(bare.centers, 0.5)))
    Render(splats=path, material="skin", albedo=albedo).load()
    (line,) = re.findall(r".*\bskin\b.*", capsys.readouterr().err)
    assert named in line
    assert "--no-albedo" not in line


def test_a_material_of_one_channel_has_three(tmp_path):
    marble, path = sj.load_material("marble"), tmp_path / "gray.toml"
    gray = jax.tree.map(lambda leaf: leaf[..., :1] if leaf.shape[-1:] == (3,) else leaf, marble)
    sj.save_material(gray, path)
    _, material = Render(splats=plate(tmp_path / "plate.ply"), material=str(path)).load()
    assert material.channels == material.angles.channels == material.medium.channels == 3


@pytest.mark.slow
@pytest.mark.once
def test_wavelengths_have_color_under_an_illuminant(plain, tmp_path, capsys):
    """And in an environment, which lights all of them alike; in the scene of the picture too."""
    nodes, path = [450.0, 530.0, 600.0, 650.0], tmp_path / "four.exr"
    material = sj.Material(sj.SumOfGaussians([0.5], [[0.1, 0.2, 0.5, 0.6]]), wavelengths=nodes)
    sj.save_material(material, tmp_path / "four.toml")
    options = "--illuminant A --environment sun --count 400 --width 32 --height 32 --output"
    words = ["render", "--material", tmp_path / "four.toml", *options.split(), path]
    assert run(*words) == 2
    assert "(--no-albedo), because" in capsys.readouterr().err
    assert run(*words, "--no-albedo") == 0
    again, options = tmp_path / "again.exr", "--illuminant A --background transparent"
    assert run("render", path, "--output", again, *options.split()) == 0
    frame = sj.read_exr(path)
    np.testing.assert_allclose(sj.read_exr(again).beauty, frame.beauty, atol=1e-5)
    rgb = sj.io.picture_to_rgb(np.asarray(frame.beauty), nodes, "A")
    picture, over = (np.asarray(Image.open(p.with_suffix(".png"))) for p in (path, again))
    np.testing.assert_allclose(picture / 255, sj.io.linear_to_srgb(rgb), atol=0.51 / 255)
    covered = np.asarray(frame.coverage) == 1
    np.testing.assert_array_equal(over[covered], np.insert(picture[covered], 3, 255, axis=-1))


@pytest.mark.parametrize(
    ("given", "kinds"),
    [
        ({}, ["EnvironmentLight"]),
        ({"fill": 0.0}, ["DirectionalLight"]),
        ({"light_elevation": 60.0}, ["DirectionalLight", "DirectionalLight"]),
        ({"environment": "sun", "fill": 0.5}, ["EnvironmentLight"]),
    ],
)
def test_a_studio_lights_where_no_light_is_given(given, kinds):
    lights = Render(**given).lights(sj.load_material("marble"), 25.0, -20.0)
    assert [type(light).__name__ for light in lights] == kinds
    if not given:
        np.testing.assert_array_equal(lights[0].image, sj.scene.studio())
        assert float(lights[0].rotation) == 0


@pytest.mark.parametrize(("width", "height"), [(64, 64), (128, 64), (64, 128)])
def test_camera_frames_the_bounding_sphere_at_any_scale_with_the_fill_beside_it(width, height):
    places = 40 * bodies.unit(np.random.default_rng(3).normal(size=(500, 3))) + [5.0, -20.0, 3.0]
    splats = bodies.splats(places, np.tile([0.0, 0.0, 1.0], (500, 1)), 1.0)
    options = Render(width=width, height=height, elevation=20.0, fill=0.1)
    camera = options.camera(lambda: [splats], 30.0)
    local = (places - np.asarray(camera.position)) @ np.asarray(camera.rotation).T
    across, along = (local[:, :2] / local[:, 2:] * float(camera.focal_length)).T
    assert 0.4 < max(np.abs(across).max() * height / width, np.abs(along).max()) < 0.5
    small = options.camera(lambda: [splats.scaled(0.2)], 30.0)
    np.testing.assert_allclose(small.position, 0.2 * camera.position, rtol=1e-4)
    np.testing.assert_allclose(small.rotation, camera.rotation, atol=1e-5)
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    distances, fills = [], []
    for azimuth in (30.0, 70.0, 190.0):
        camera = options.camera(lambda: [splats], azimuth)
        _, fill = options.lights(sj.load_material("marble"), azimuth, -20.0)
        distances.append(np.linalg.norm(np.asarray(camera.position) - middle))
        fills.append(np.asarray(camera.rotation @ fill.direction))
    np.testing.assert_allclose(distances, distances[0], rtol=1e-5)
    np.testing.assert_allclose(fills, fills[:1] * 3, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "direction"),
    [((0.0, 0.0), [0, 0, 1]), ((90.0, 0.0), [1, 0, 0]), ((0.0, 30.0), [0, 0.5, 0.75**0.5])],
)
def test_azimuth_turns_from_the_front_to_the_side(place, direction):
    np.testing.assert_allclose(direction_to(*place), direction, atol=1e-6)


def test_what_was_compiled_is_taken_from_the_cache_in_silence(tmp_path, monkeypatch, events, capfd):
    """XLA logs an error for whatever it takes from there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    prepare_jax({})
    assert Path(jax.config.jax_compilation_cache_dir).parent == tmp_path / "splatjax" / "jax"
    compilation_cache.reset_cache()
    for hits in (0, 1):  # a new function, of the same program
        jax.jit(lambda x: jnp.cumsum(jnp.sin(x)))(jnp.ones(9)).block_until_ready()
        assert events.count("/jax/compilation_cache/cache_hits") >= hits
    assert capfd.readouterr().err == ""


PICTURES = """[[pictures]]
file = "one.exr"
camera = {{ position = [0, 0, 80], target = [0, 0, 0], fov = 20 }}
{more}
[[pictures.lights]]
kind = "directional"
direction = [0, 0, -1]
irradiance = 3
"""
FOUND = (0.011, 0.022, 0.033)


@pytest.fixture
def command(tmp_path):
    write_picture(tmp_path / "one.exr", np.full((8, 8, 3), 0.5))
    (tmp_path / "pictures.toml").write_text(PICTURES.format(more=""))
    files = plate(tmp_path / "plate.ply"), tmp_path / "pictures.toml"
    return ["recover", *files, "--output", tmp_path / "mine.toml", "--no-suggest"]


@pytest.fixture
def search(monkeypatch):
    """A search that finds the same for every input. Returns the arguments of its calls, and a list
    of how the next ones end: interrupted, or before they have settled.
    """
    calls, ends = [], []

    def recover(observations, splats, starts, *, surface, progress, **options):
        calls.append((observations, splats, starts, options))
        medium = sj.Medium(jnp.asarray(FOUND), starts[0].sigma_s_prime, starts[0].eta)
        progress("rendering", starts[0])
        progress("round 1", medium)
        ended = ends.pop() if ends else optx.RESULTS.successful
        if isinstance(ended, BaseException):
            raise ended
        seen = np.array(observations[0].picture, float)
        seen[5:] = np.nan
        return sj.inverse.Recovery(
            medium=medium,
            material=surface,
            intensities=jnp.ones((1, 3)),
            information=jnp.diag(jnp.asarray([1e4, 1e4, 1e4, 1e4, 1e4, 1.0, 0.0, 0.0, 0.0])),
            unresolved=jnp.zeros(3),
            chi_squared=jnp.asarray(1.0),
            pictures=(seen + 0.01,),
            residuals=(seen * 0 + 0.01,),
            ends=(medium,),
            costs=jnp.zeros(1),
            result=ended,
            noise_is_known=True,
            relative_noise=0.01,
            steps=5,
            rounds=1,
        )

    monkeypatch.setattr(sj.inverse, "recover", recover)
    return calls, ends


def test_it_writes_a_material_and_a_report_with_what_is_not_fixed(
    command, search, tmp_path, capsys
):
    output, report = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert run(*command, "--start", "skin1", "marble", "--report", report, "--robust") == 0
    printed = capsys.readouterr().out
    assert "red: sigma_a 0.011 +- 1%, sigma_s' 0.74 +- 1%" in printed
    assert "not fixed by these pictures: sigma_s', known to 100%" in printed
    assert printed.splitlines()[-2:] == [str(output), str(report)]
    with Image.open(report) as picture:
        assert min(picture.size) > 200
    np.testing.assert_allclose(sj.load_medium(output).sigma_a, FOUND, rtol=1e-6)
    assert "recovered by splatjax" in output.read_text()
    assert not list(tmp_path.glob("*.json"))
    ((observations, splats, starts, options),) = search[0]
    assert observations[0].picture.shape == (8, 8, 3)
    assert splats.albedo is None
    np.testing.assert_allclose(starts[1].sigma_a, sj.load_medium("marble").sigma_a, rtol=1e-6)
    assert (options["model"], options["count"]) == (sj.fitting.TransportModel(), 6)
    assert isinstance(options["loss"], sj.inverse.HuberLoss)


@pytest.mark.parametrize(("more", "eta"), [([], 1.5), (["--eta", 1.42], 1.42)])
def test_the_index_of_refraction_is_of_the_first_start_or_the_one_given(
    more, eta, command, search, tmp_path
):
    assert run(*command, "--start", "marble", "skin1", *more) == 0
    for start in search[0][0][2]:
        np.testing.assert_allclose(start.eta, 3 * [eta], rtol=1e-6)
    assert sj.load_material(tmp_path / "mine.toml").eta == pytest.approx(eta)


def test_interrupted_or_unsettled_it_continues_where_it_was(command, search, tmp_path, capsys):
    calls, ends = search
    output, record = tmp_path / "mine.toml", tmp_path / "mine.search.json"
    ends += [optx.RESULTS.nonlinear_max_steps_reached, KeyboardInterrupt()]
    for number, status in enumerate((130, 0)):
        assert run(*command) == status
        assert record.exists()
        assert output.exists() == (number == 1)  # its best round
        assert len(calls[number][2]) == 2 - number
    assert "--start" in capsys.readouterr().err
    np.testing.assert_allclose(calls[1][2][0].sigma_a, FOUND)
    (tmp_path / "pictures.toml").write_text(PICTURES.format(more="noise = 0.01"))
    assert run(*command) == 0
    assert str(record) in capsys.readouterr().err  # of another search
    assert len(calls[2][2]) == 2
    assert not record.exists()
