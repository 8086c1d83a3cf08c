"""The page of a studio: with viser, `pip install viser`; and in a browser, with `pip install
playwright` and Debian's chromium.
"""

import dataclasses
import io
import shutil
import time

import equinox as eqx
import numpy as np
import pytest
from pictures import write_picture
from PIL import Image

import splatjax as sj
from splatjax.cli._studio import Studio
from splatjax.studio import Page, Session

SIDE = 48  # of the pictures of `studio`, pixels

# Of viser and of the libraries that it stands on.
VISER = pytest.mark.filterwarnings("default")
PATIENCE = 240  # s, in which programs are compiled
# Levels of 255, of the mean: JPEG, and the browser's scaling.
SHOWN = 6.0


def wait_until(is_true) -> None:
    end = time.monotonic() + PATIENCE
    while not is_true() and time.monotonic() < end:
        time.sleep(0.1)
    assert is_true()


@pytest.fixture
def page(studio, tmp_path):
    pytest.importorskip("viser")
    session = Session(studio.own, studio.camera(studio.start), [0, 0, 0])
    (tmp_path / "saved").mkdir()
    page = Page(session, tmp_path / "saved", port=18_080)
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
    np.testing.assert_allclose(saved, 2 * sj.load_medium("marble").sigma_a, rtol=1e-6)
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
    np.testing.assert_allclose(powers, np.log2(1.5), atol=0.06)
    wait_until(lambda: searching._status.content == "")
    assert np.abs(searching._compared.image[:, SIDE:].astype(int) - 128).max() <= 1
    searching.close()


@VISER
def test_a_browser_picks_drags_orbits_and_saves(page, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium")
    start, image = page._place, page._image
    with playwright.sync_playwright() as driver:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        window = browser.new_page(viewport={"width": 900, "height": 500})

        def shows_the_picture(window=window) -> None:
            wait_until(lambda: page._image.size == (SIDE, SIDE) and page._status.content == "")
            window.wait_for_timeout(3000)
            picture = Image.open(io.BytesIO(window.screenshot())).convert("RGB")
            middle = picture.crop((80, 0, 580, 500)).resize((SIDE, SIDE), Image.Resampling.BOX)
            seen, made = (np.asarray(each, float) for each in (middle, page._image))
            shown = np.abs(seen - made)[:, 23:45]  # between a note of viser and the panel
            assert shown.mean() < SHOWN

        window.goto(page.url)
        window.wait_for_selector("text=turn lights")
        shows_the_picture()
        window.mouse.click(335, 200)
        wait_until(lambda: "| radiance |" in page._pixel.content)
        assert page._pixel.content.startswith("| pixel 24, 19 | red | green | blue |")
        of_medium = (f"{name}, by powers of 2" for name in ("absorption", "scattering"))
        for folder in (*of_medium, "weights, by factors"):
            window.get_by_text(folder).click()
        sliders = window.get_by_role("slider")
        moving = {name: handle.value for name, handle in page._handles.items() if name != "layer"}
        wait_until(lambda: sliders.count() == len(moving))
        for number in range(len(moving)):
            sliders.nth(number).focus()
            window.keyboard.press("ArrowLeft")
            window.wait_for_timeout(100)
        wait_until(lambda: all(page._handles[name].value < moving[name] for name in moving))
        window.reload()
        window.wait_for_selector("text=turn lights")
        shows_the_picture()
        window.mouse.move(200, 250)
        window.mouse.down()
        window.mouse.move(260, 250, steps=5)
        window.mouse.up()
        wait_until(lambda: np.abs(page._place - start).max() > 5)
        second = browser.new_page(viewport={"width": 900, "height": 500})
        second.goto(page.url)
        second.wait_for_selector("text=turn lights")
        for each in (window, second):  # of one camera, which moved before the second came
            shows_the_picture(each)
        window.get_by_role("button", name="PNG", exact=True).click()
        wait_until(lambda: [*tmp_path.rglob("studio_000.png")])
        browser.close()
    assert page._image is not image


SCENE = """
material = "marble"
[splats]
bust = 1500
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
[[lights]]
kind = "point"
position = [-30, 0, 60]
intensity = 1000
[settings]
bounces = 1
"""


@VISER
def test_a_scene_file_opens_and_what_is_saved_is_one(tmp_path):
    pytest.importorskip("viser")
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
    np.testing.assert_allclose(lamp.intensity, 250)
    assert float(sky.rotation) == 30.0
    picture = sj.render(of_exr, camera, settings)
    assert picture.beauty.max() > 0.1
    np.testing.assert_allclose(
        picture.beauty, sj.read_exr(looks / "studio_001.exr").beauty, atol=0.004
    )
