"""The page of a studio, with viser, and the studio in a cell of a notebook: driven as a browser
drives them, by values and events.
"""

import asyncio
import dataclasses
import time
from types import SimpleNamespace

import equinox as eqx
import ipywidgets
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pictures import write_picture

import splatjax as sj
from splatjax.cli._studio import Studio
from splatjax.studio import Page, widget

SIDE = 48  # of the pictures of `studio`, pixels

# Of viser and of the libraries that it stands on.
VISER = pytest.mark.filterwarnings("default")
PATIENCE = 240  # s, in which programs are compiled


def wait_until(is_true) -> None:
    end = time.monotonic() + PATIENCE
    while not is_true() and time.monotonic() < end:
        time.sleep(0.1)
    assert is_true()


@pytest.fixture
def page(another, tmp_path):
    (tmp_path / "saved").mkdir()
    page = Page(another(), tmp_path / "saved", port=18_080)
    yield page
    page.close()


@VISER
def test_only_this_computer_reaches_the_page_and_it_writes_to_one_folder(page, tmp_path):
    assert page.url.startswith("http://127.0.0.1:")
    assert page.url in page._repr_html_()  # as a notebook shows it
    assert page._server.get_host() == "127.0.0.1"
    assert page._server.request_share_url() is None
    page._handles["sigma_a 0"].value = 1.0
    page._change("PNG", "material")
    names = ["studio_000.png", "studio_001.toml"]
    wait_until(lambda: len([*tmp_path.rglob("studio_*.*")]) == len(names))
    assert sorted(path.name for path in (tmp_path / "saved").iterdir()) == names
    saved = sj.load_medium(tmp_path / "saved" / "studio_001.toml").sigma_a
    assert_allclose(saved, 2 * sj.load_medium("marble").sigma_a, rtol=1e-6)
    wait_until(lambda: "studio_000.png" in page._status.content)
    page._change("/../PDF")  # a fault is a sentence, and the page goes on
    wait_until(lambda: "Error" in page._status.content)
    page._change()
    wait_until(lambda: page._status.content == "")


@VISER
@pytest.mark.long
def test_the_material_of_pictures_is_found_live_and_again_after_a_stop(page, tmp_path):
    """Of a small picture of the page's own, whose error bars are 5 to 14%."""
    session = page._session
    start = session.start
    dark = dataclasses.replace(start, sigma_a=tuple(1.5 * number for number in start.sigma_a))
    session.picture(dark)  # whose variances and angles are then those of the coefficients
    target = session.frame(dark).beauty
    camera, lights = session.camera(start), session.own.lights
    observation = sj.inverse.Observation(target, camera, lights)
    searching = Page(session, tmp_path, observations=[observation], port=18_090)
    press = searching._search.start
    press(searching.controls)
    searching._search.stop()
    wait_until(lambda: "stopped" in searching._stage.content)
    press(searching.controls)
    wait_until(lambda: "error bars" in searching._stage.content)
    powers = [searching._handles[f"sigma_a {channel}"].value for channel in (1, 2, 3)]
    assert_allclose(powers, np.log2(1.5), atol=0.06)
    wait_until(lambda: searching._status.content == "")
    assert np.abs(searching._compared.image[:, SIDE:].astype(int) - 128).max() <= 1
    searching.close()


@VISER
def test_a_page_picks_and_follows_the_camera_of_a_window(page):
    """As viser reports a click and a camera, of a window wider than the picture."""
    start, canvases = page._place, []
    scene = SimpleNamespace(set_background_image=lambda canvas, *_, **how: canvases.append(canvas))
    window = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=1.8))
    camera = SimpleNamespace(client=window, position=start[0], look_at=start[1])
    wait_until(lambda: page._image.size == (SIDE, SIDE))
    page._look(camera)
    assert canvases[-1].shape == (SIDE, round(1.8 * SIDE), 3)
    page._pick(SimpleNamespace(client=window, screen_pos=(335 / 900, 0.4)))
    wait_until(lambda: "| radiance |" in page._pixel.content)
    assert page._pixel.content.startswith("| pixel 24, 19 | red | green | blue |")
    before, camera.position = page._image, start[0] + [10.0, 0.0, 0.0]
    page._look(camera)
    wait_until(lambda: page._image is not before and page._status.content == "")
    assert_allclose(page._place, [camera.position, start[1]])
    page._look_again()
    assert_allclose(window.camera.position, start[0])


SCENE = """
material = "marble"
[splats]
bust = 600
scale = 0.1
albedo = false
[camera]
position = [20, 0, 70]
target = [0, -3, 0]
width = 48
height = 48
[[lights]]
kind = "environment"
image = "maps/sky.exr"
count = 4
[[lights]]
kind = "point"
position = [-30, 0, 60]
intensity = 1000
[settings]
bounces = 1
"""


@VISER
def test_a_scene_file_opens_and_what_is_saved_is_one(tmp_path):
    scene, looks = tmp_path / "scene.toml", tmp_path / "looks"
    scene.write_text(SCENE)
    (tmp_path / "maps").mkdir()
    write_picture(tmp_path / "maps" / "sky.exr", np.asarray(sj.scene.overcast_sky()))
    page = Studio(splats=scene, output=looks, port=18_070).page()
    page._handles["light 1"].value = -2.0
    page._handles["turn"].value = 30.0
    page._change("scene", "EXR")
    wait_until(lambda: "studio_001.exr" in page._status.content)
    page.close()
    assert {path.name for path in looks.iterdir()} == {
        "studio_000.toml",
        "studio_000.py",
        "studio_001.exr",
    }
    saved, *_ = sj.io.load_scene(looks / "studio_000.toml")
    of_exr, camera, settings = sj.io.load_scene(looks / "studio_001.exr")
    assert eqx.tree_equal(saved, of_exr)
    assert settings.bounces == 1
    lamp, sky = saved.lights[1], saved.lights[0]
    assert_allclose(lamp.intensity, 250)
    assert float(sky.rotation) == 30.0
    picture = sj.render(of_exr, camera, settings)
    assert picture.beauty.max() > 0.1
    assert_allclose(picture.beauty, sj.read_exr(looks / "studio_001.exr").beauty, atol=0.004)


EVENT = {"buttons": (1,), "type": "pointer_move"}


@pytest.fixture
def shown(another, tmp_path):
    return widget(another(), tmp_path / "saved")


def parts(box) -> list:
    """List a widget and all that is in it."""
    return [box, *(part for child in getattr(box, "children", ()) for part in parts(child))]


def found(box, kind: type, label: str):
    (part,) = [p for p in parts(box) if isinstance(p, kind) and p.description == label]
    return part


def labels(box) -> list[str]:
    return [part.value for part in parts(box) if isinstance(part, ipywidgets.Label)]


def canvas(box):
    return box.children[0].children[0]


def drawn(box) -> list[np.ndarray]:
    """Return the pictures that a browser gets, at once and when nothing moves any more."""
    sent = []

    async def look():
        canvas(box).send_frame = sent.append
        sent.append(canvas(box).get_frame())
        await asyncio.sleep(0.5)

    asyncio.run(look())
    return sent


def test_a_widget_shows_the_picture_of_its_controls(shown, studio, another):
    assert shown.controls == studio.start
    next(s for s in parts(shown) if getattr(s, "description", "") == "all").value = 1.0
    found(shown, ipywidgets.FloatSlider, "exposure, stops").value = 0.5
    doubled = tuple(2 * number for number in studio.start.sigma_a)
    assert shown.controls == dataclasses.replace(studio.start, sigma_a=doubled, exposure=0.5)
    draft, picture = drawn(shown)
    session = another()
    assert_array_equal(draft, session.draft(shown.controls))
    assert_array_equal(picture, session.picture(shown.controls))
    text = " ".join(part.value for part in parts(shown) if isinstance(part, ipywidgets.HTML))
    assert f"absorption: {doubled[0]:.4g}" in text
    assert "<svg" in text


def test_a_mouse_orbits_zooms_moves_and_picks(shown):
    def send(**event) -> None:
        canvas(shown).handle_event(EVENT | event)

    def place() -> np.ndarray:
        return np.asarray([shown.controls.eye, shown.controls.target])

    before = place()
    send(type="pointer_down", x=24, y=20)
    send(x=36, y=20)  # a quarter of the picture's height, to the right: half a right angle
    turned = place()
    assert_allclose(turned[:, 1], before[:, 1])
    angle = np.angle(complex(turned[0, 2], turned[0, 0]) / complex(before[0, 2], before[0, 0]))
    assert_allclose(np.degrees(angle), -45)
    send(x=36, y=1000)  # not beyond the pole
    assert 0 < np.hypot(place()[0, 0], place()[0, 2]) < 0.02 * place()[0, 1]
    assert_allclose(np.linalg.norm(place()[0]), np.linalg.norm(before[0]))
    send(type="pointer_up", x=36, y=1000)
    send(x=10, y=10, buttons=())  # no button, no change
    found(shown, ipywidgets.Button, "first view").click()
    assert_array_equal(place(), before)
    # The target moves as many pixels as the mouse.
    camera = sj.Camera.look_at(*before, width=48, height=48)
    send(x=34, y=16, buttons=(2,))
    shift = camera.rotation @ (before[1] - place()[1])
    depth = np.linalg.norm(before[0] - before[1])
    assert_allclose(shift * camera.focal_length * 48 / depth, [24, 6, 0], atol=1e-4)
    found(shown, ipywidgets.Button, "first view").click()
    send(type="wheel", dy=500 * np.log(2))
    assert_allclose(place()[0], 2 * before[0])
    found(shown, ipywidgets.Button, "first view").click()
    send(type="pointer_down", x=24.3, y=20.8)
    send(type="pointer_up", x=24.3, y=20.8)
    drawn(shown)
    texts = [part.value for part in parts(shown) if isinstance(part, ipywidgets.HTML)]
    assert any("pixel 24, 20" in text for text in texts)


def test_a_widget_writes_to_its_folder_and_shows_a_fault(shown, tmp_path):
    found(shown, ipywidgets.Button, "material").click()
    (path,) = (tmp_path / "saved").iterdir()
    assert sj.load_material(path).channels == 3
    assert f"saved {path}" in labels(shown)
    path.rename(tmp_path / "kept.toml")
    (tmp_path / "saved").rmdir()
    (tmp_path / "saved").write_text("a file")
    found(shown, ipywidgets.Button, "PNG").click()
    assert any("exists" in label for label in labels(shown))
