"""A scene under changing controls: what is shown is what `render` makes of it, what is kept stays
bounded, and what is saved makes the picture again.
"""

import runpy
from dataclasses import replace as with_

import equinox as eqx
import jax
import numpy as np
import pytest
from bodies import assert_close, assert_refused
from PIL import Image

import splatjax as sj
from splatjax.diffusion import ShapeDiffuser
from splatjax.scattering import HalfSpace
from splatjax.studio import Search, Session, save, turned
from splatjax.studio._sliders import values_of_medium

# Levels of 255: rounding.
SAME = 1
# The mean of a picture of 375 splats and 16 x 16 pixels.
COARSE = 0.25


@pytest.fixture(scope="module")
def states(studio):
    """One change of each kind, each beside those before."""
    double = tuple(2 * number for number in studio.start.sigma_a)
    absorption = with_(studio.start, sigma_a=double, exposure=0.5)
    surface = with_(absorption, eta=1.3, specular=0.5, roughness=0.5, scale=0.7)
    moved = with_(surface, eye=(-40.0, 20.0, 30.0), turn=70.0, light_stops=(-0.5, 1.0))
    return {"absorption": absorption, "surface": surface, "camera and light": moved}


def shown(frame, controls) -> np.ndarray:
    return sj._display.to_display(np.asarray(frame.beauty), controls.exposure).astype(int)


@pytest.mark.parametrize("name", ["absorption", "surface", "camera and light"])
def test_a_picture_is_that_of_render(studio, states, name):
    controls = states[name]
    draft, picture = studio.draft(controls).astype(int), studio.picture(controls)
    assert picture.max() > 50
    frame = sj.render(studio.scene(controls), studio.camera(controls))
    assert np.abs(shown(frame, controls) - picture).max() <= SAME
    assert draft.mean() == pytest.approx(picture.mean(), rel=COARSE)


@pytest.mark.parametrize(
    ("eye", "up", "moved"),
    [
        ((20.0, 0.0, 70.0), (1.0, 0.0, 0.0), (70.0, 0.0, 20.0)),
        ((0.0, 70.0, 0.0), (0.0, 0.0, -1.0), (0.0, 80.0, 0.0)),
    ],
)
def test_the_first_camera_is_the_one_given_and_others_are_upright(studio, eye, up, moved):
    camera = sj.Camera.look_at(eye, (0, 0, 0), up=up, fov=20, width=24, height=16, near=5)
    camera = with_(camera, principal_point=(0.3, 0.4))
    session = Session(studio.own, camera, [0, 0, 0])
    assert eqx.tree_equal(session.camera(session.start), camera)
    up = up if moved[0] == 0 else (0, 1, 0)
    expected = sj.Camera.look_at(moved, (0, 0, 0), up=up, fov=20, width=24, height=16, near=5)
    expected = with_(expected, principal_point=(0.3, 0.4))
    assert_close(session.camera(with_(session.start, eye=moved)), expected, atol=1e-6)


@pytest.mark.long
def test_the_whole_picture_has_the_settings(studio, another, states):
    controls, settings = states["absorption"], sj.RenderSettings(diffuser=ShapeDiffuser())
    session = another(settings)
    for state in (studio.start, controls):
        session.draft(state)
        picture = session.picture(state).astype(int)
        frame = sj.render(session.scene(state), session.camera(state), settings)
        assert np.abs(shown(frame, state) - picture).max() <= SAME
    draft = session.draft(controls).astype(int)
    assert np.abs(picture - draft).max() > 20
    usual = sj.render(session.scene(controls), session.camera(controls))
    assert np.abs(shown(usual, controls) - draft).max() <= SAME


def test_coefficients_are_fitted_as_a_material_is(studio, states):
    """The Gaussians of changed coefficients conserve the total of light transport; at rest their
    error is not above that of the variances before.
    """
    controls = states["absorption"]
    studio.picture(studio.start)
    model, errors = studio.model(studio.start), []
    for settle in (studio.draft, studio.picture):
        settle(controls)
        material = studio.scene(controls).material
        profile = model.profile(material.medium)
        total = profile.total_reflectance()
        np.testing.assert_allclose(material.gaussians.total_reflectance(), total, rtol=1e-5)
        errors.append(sj.fitting.relative_error(profile, material.gaussians, model.rule))
    assert np.max(errors[1]) < np.max(errors[0])
    own = studio.own.material
    np.testing.assert_allclose(material.medium.sigma_a, 2 * own.medium.sigma_a, rtol=1e-6)
    np.testing.assert_array_less(material.gaussians.total_reflectance(), own.total_reflectance())
    radii, *rows = studio.curves(controls)
    assert [row.shape for row in rows] == [radii.shape] * 6


def test_the_phase_function_changes_the_total_as_light_transport_does(studio, tmp_path):
    """For held reduced coefficients, by a few parts in a thousand; a saved material has its mean
    cosine.
    """
    controls = with_(studio.start, g=0.9, sigma_a=studio.start.sigma_s_prime)
    studio.picture(controls)
    material = studio.scene(controls).material
    totals = (HalfSpace(material.medium, g).total_reflectance() for g in (0.9, 0.0))
    forward, isotropic = map(np.asarray, totals)
    assert np.all(np.abs(forward / isotropic - 1) > 1e-3)
    np.testing.assert_allclose(material.gaussians.total_reflectance(), forward, rtol=1e-4)
    (path,) = save(studio, controls, tmp_path, "material")
    assert sj.io.load_mean_cosine(path) == pytest.approx(0.9)


def test_a_state_depends_on_no_other_before(studio, states):
    """Of albedo 1/2, where the Gaussians are a thousand times as narrow, and back."""
    controls = states["absorption"]
    studio.picture(controls)
    before = studio.scene(controls).material.gaussians
    studio.picture(with_(studio.start, sigma_a=studio.start.sigma_s_prime))
    studio.picture(controls)
    assert eqx.tree_equal(studio.scene(controls).material.gaussians, before)


@pytest.mark.parametrize(
    "wrong", [{"g": 1.0}, {"layer": "depth"}, {"scale": -0.1}, {"factors": (1.0, -1.0)}]
)
def test_a_state_that_cannot_be_is_refused(studio, wrong):
    assert_refused(lambda: with_(studio.start, **wrong), rf"{next(iter(wrong))} (is|are)")


def test_scenes_and_lights_that_a_studio_cannot_take_are_refused(studio, another):
    material = studio.own.material
    bare = another(material=with_(material, medium=None))
    assert_refused(lambda: Search(bare, [], print), r"add \[medium\]")
    single = with_(material, single_scattering=sj.SingleScattering(material.medium))
    assert_refused(lambda: another(material=single), "has single scattering")
    harmonic = sj.scene.HarmonicLight(np.zeros((4, 3)))
    assert_refused(lambda: turned([harmonic], 1.0), "HarmonicLight cannot be turned")


def test_a_material_is_saved_with_coefficients_only_if_they_give_its_weights(studio, tmp_path):
    for changes, is_fitted in ({}, True), ({"scale": 0.5}, False):
        controls = with_(studio.start, **changes)
        (path,) = save(studio, controls, tmp_path, "material")
        assert (sj.load_material(path).medium is not None) == is_fitted
        total = studio.own.material.total_reflectance() * controls.scale
        np.testing.assert_allclose(sj.load_material(path).total_reflectance(), total, rtol=1e-5)


def test_a_coefficient_of_zero_stays_zero(studio):
    _, second, third = studio.start.sigma_a
    start = with_(studio.start, sigma_a=(0.0, 0.0, third))
    found = sj.Medium([0.0, second, 2 * third], start.sigma_s_prime, 1.5)
    values = values_of_medium(start, found)
    powers = [values[f"sigma_a {channel}"] for channel in range(4)]
    np.testing.assert_allclose(powers, [0, 0, 4, 1], atol=1e-6)


def test_factors_change_colors_or_only_widths_where_splats_have_color(studio, another):
    factors = (2.0, *[0.0] * (len(studio.start.factors) - 2), 1.0)
    controls = with_(studio.start, factors=factors)
    held = studio.own.material.gaussians
    held = sj.SumOfGaussians(held.variances, held.weights * np.asarray(factors)[:, None])
    bare = studio.own.splats
    colored = with_(bare, albedo=np.full((bare.count, 3), 0.5))
    for splats, gaussians in ((bare, held), (colored, held.white())):
        material = another(splats=splats).scene(controls).material
        assert eqx.tree_equal(material.gaussians, gaussians)


@pytest.fixture(scope="module")
def skin_studio(another):
    material, skin = sj.load_material("skin_light"), sj.io.load_skin("skin_light")
    return another(skin=skin, material=material)


def test_pigments_change_skin_as_a_fit_does(skin_studio, tmp_path):
    """More melanin is darker and more blood is redder; files hold the changed skin."""
    start = skin_studio.start
    own = skin_studio.scene(start).material
    assert eqx.tree_equal(own.gaussians, sj.load_material("skin_light").gaussians)
    totals = {}
    for name, value in (("melanin", 0.2), ("blood", 0.05)):
        controls = with_(start, skin=tuple({**dict(start.skin), name: value}.items()))
        assert skin_studio.picture(controls).max() > 50
        material = skin_studio.scene(controls).material
        skin = with_(sj.io.load_skin("skin_light"), **{name: value})
        colors = skin.profile().total_reflectance() @ sj.io.spectrum_to_rgb(skin.wavelengths)
        totals[name] = material.gaussians.total_reflectance()
        np.testing.assert_allclose(totals[name], colors, rtol=1e-4)
        assert not eqx.tree_equal(material.angles, own.angles)
    before = own.gaussians.total_reflectance()
    assert np.all(totals["melanin"] < 0.8 * before)
    ratio = totals["blood"] / before
    assert ratio[0] > 1.2 * ratio[1]
    for path in save(skin_studio, controls, tmp_path, "material"):
        assert eqx.tree_equal(sj.io.load_skin(path), skin_studio.optics(controls))


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
def test_wavelengths_are_shown_in_color(another):
    nodes = [450.0, 530.0, 600.0, 650.0]
    gaussians = sj.SumOfGaussians([0.5, 2.0], [[0.05, 0.1, 0.2, 0.2], [0.05, 0.1, 0.3, 0.4]])
    material = sj.Material(gaussians, wavelengths=nodes)
    skin, light = sj.scattering.Skin(wavelengths=nodes), sj.DirectionalLight([1, -0.3, -1], 3.0)
    studio = another(material=material, skin=skin, lights=[light])
    for layer in ("beauty", "shadow"):
        controls = with_(studio.start, layer=layer)
        frame = studio.frame(controls)
        values = frame.beauty if layer == "beauty" else np.repeat(frame.shadow[0][..., None], 4, 2)
        rgb = sj.io.picture_to_rgb(np.asarray(values), nodes)
        expected = sj._display.to_display(rgb).astype(int)
        assert np.abs(expected - studio.picture(controls)).max() <= SAME
    assert len(studio.curves(studio.start)) == 1 + 4 + 4


def test_a_pixel_of_skin_changes_with_its_pigments(skin_studio):
    start = skin_studio.start
    skin_studio.picture(start)
    parts, place = skin_studio.pixel(start, 25, 15), (25, 15)
    for name in ("melanin", "blood"):
        values = dict(start.skin)
        low, high = (
            skin_studio.pixel(
                with_(start, skin=tuple({**values, name: f * values[name]}.items())), *place
            )["radiance"]
            for f in (np.exp(-0.05), np.exp(0.05))
        )
        difference = (high - low) / 0.1
        np.testing.assert_allclose(parts[f"per ln {name}"], difference, rtol=0.05, atol=2e-4)


def test_a_pixel_is_the_sum_of_its_parts(studio, states):
    """Its changes with the coefficients are differences of pictures of held variances."""
    controls = states["absorption"]
    studio.picture(controls)
    frame, column, row = studio.frame(controls), 25, 15
    radiance, highlight, *rest = studio.pixel(controls, column, row).values()
    assert frame.coverage[row, column] == 1
    assert radiance.min() > 0.1
    expected = frame.beauty[row, column], frame.specular[row, column]
    np.testing.assert_allclose((radiance, highlight), expected, rtol=1e-4)
    light = frame.weights * frame.layers[:, row, column]
    np.testing.assert_allclose(rest[:-2], light, rtol=1e-3, atol=1e-5)
    for field, change in zip(("sigma_a", "sigma_s_prime"), rest[-2:], strict=True):
        ends = [
            studio.pixel(with_(controls, **{field: tuple(factor * x for x in value)}), column, row)
            for value in [getattr(controls, field)]
            for factor in (np.exp(-0.01), np.exp(0.01))
        ]
        difference = (ends[1]["radiance"] - ends[0]["radiance"]) / 0.02
        np.testing.assert_allclose(change, difference, rtol=0.02, atol=1e-4)


def test_many_changes_compile_nothing_and_keep_nothing(studio, compiled):
    def change(i: int) -> None:
        factor, moved = 1.5 + 0.3 * np.sin(i), {"scale": 0.5 + 0.4 * np.cos(i)}
        if i % 10 == 0:
            moved["sigma_a"] = tuple(factor * number for number in studio.start.sigma_a)
        if i % 50 == 0:
            moved["eye"] = 20.0 * np.cos(i), 5.0, 70.0
        studio.draft(with_(studio.start, **moved))

    studio.picture(studio.start)
    for i in range(20):
        change(i)
    compiled.clear()
    before = len(jax.live_arrays()), sum(array.nbytes for array in jax.live_arrays())
    for i in range(20, 140):
        change(i)
    assert compiled == []
    after = len(jax.live_arrays()), sum(array.nbytes for array in jax.live_arrays())
    np.testing.assert_array_less(after, 1.01 * np.asarray(before))


@pytest.mark.parametrize("layer", ["diffuse", "specular", "albedo", "irradiance", "shadow"])
def test_layers_are_those_of_the_frame(studio, layer):
    controls = with_(studio.start, layer=layer)
    frame = studio.frame(controls)
    layers = {
        "shadow": np.asarray(frame.shadow).mean(axis=0)[..., None],
        "irradiance": frame.irradiance / np.pi,
    }
    expected = sj._display.to_display(np.asarray(layers.get(layer, getattr(frame, layer, None))))
    assert np.abs(expected.astype(int) - studio.picture(controls)).max() <= SAME


def test_what_is_saved_makes_the_picture_again(studio, states, tmp_path, monkeypatch):
    monkeypatch.setattr(sj.cache, "keep", lambda: None)
    controls = with_(states["camera and light"], turn=30.0)
    paths = [
        path
        for kind in ("PNG", "EXR", "material", "scene")
        for path in save(studio, controls, tmp_path, kind)
    ]
    names = ["studio_000.png", "studio_001.exr", "studio_002.toml", "studio_003.toml"]
    assert [path.name for path in paths] == [*names, "studio_003.py"]
    assert {path.name for path in tmp_path.iterdir()} == {*names, "studio_003.py", "studio_003.ply"}
    runpy.run_path(str(paths[-1]))
    first, again = (
        np.asarray(Image.open(path), int) for path in (paths[0], paths[-1].with_suffix(".png"))
    )
    assert np.abs(first - again).max() <= SAME
    assert np.abs(shown(sj.read_exr(paths[1]), controls) - first).max() <= SAME
    assert eqx.tree_equal(sj.load_material(paths[2]), sj.io.load_scene(paths[3])[0].material)


def test_lights_turn_about_the_vertical_axis():
    sky = sj.EnvironmentLight(np.ones((4, 8, 3)), 10.0)
    lights = sj.DirectionalLight([0, -1, 1], 3.0), sj.PointLight([0, 5, 2], 3.0), sky
    expected = sj.DirectionalLight([1, -1, 0], 3.0), sj.PointLight([2, 5, 0], 3.0)
    *others, environment = turned(lights, 90.0)
    assert_close(others, expected, atol=1e-6)
    assert float(environment.rotation) == 100.0
