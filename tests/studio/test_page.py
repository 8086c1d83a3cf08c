"""The page of the studio: with viser, `pip install viser`; and in a browser, with
`pip install playwright` and Debian's chromium:

    python -m pytest tests/studio/test_page.py
"""

import dataclasses
import io
import shutil
import time

import numpy as np
import pytest
from PIL import Image

import splatjax as sj
from splatjax.studio import Page, Session

viser = pytest.importorskip("viser")
# Of viser and of the libraries that it stands on.
pytestmark = [pytest.mark.once, pytest.mark.filterwarnings("default")]

SIDE = 48
PATIENCE = 240  # s, in which programs are compiled
# Levels of 255, of the mean: JPEG, and the browser's scaling.
SHOWN = 6.0


@pytest.fixture
def page(tmp_path):
    splats = dataclasses.replace(sj.bust(1500).scaled(0.1), albedo=None)
    lamp = sj.DirectionalLight([1, -0.3, -1], 3.0)
    camera = sj.Camera.look_at([20, 0, 70], [0, 0, 0], width=SIDE, height=SIDE)
    session = Session(sj.Scene(splats, lamp, sj.load_material("marble")), camera, [0, 0, 0])
    (tmp_path / "saved").mkdir()
    recipe = {"splats": "splats", "lights": "lights"}
    page = Page(session, tmp_path / "saved", recipe, port=18_080)
    yield page
    page.close()


def wait_until(is_true) -> None:
    end = time.monotonic() + PATIENCE
    while not is_true() and time.monotonic() < end:
        time.sleep(0.1)
    assert is_true()


def test_only_this_computer_reaches_the_page_and_it_writes_to_one_folder(page, tmp_path):
    assert page.url.startswith("http://127.0.0.1:")
    assert page._server.get_host() == "127.0.0.1"
    assert page._server.request_share_url() is None
    page._handles["sigma_a 0"].value = 1.0
    page._change("PNG", "Python")
    names = ["studio_000.png", "studio_001.py", "studio_001.toml"]
    wait_until(lambda: len([*tmp_path.rglob("studio_*.*")]) == len(names))
    assert sorted(path.name for path in (tmp_path / "saved").iterdir()) == names
    saved = sj.load_medium(tmp_path / "saved" / "studio_001.toml").sigma_a
    np.testing.assert_allclose(saved, 2 * sj.load_medium("marble").sigma_a, rtol=1e-6)
    wait_until(lambda: page._status.content.startswith("saved studio_000.png"))
    page._change("/../PDF")  # a fault is a sentence, and the page goes on
    wait_until(lambda: "Error" in page._status.content)
    page._change()
    wait_until(lambda: page._status.content == "")


def test_it_shows_itself_in_a_notebook(page):
    assert page.url in page._repr_html_()


@pytest.mark.long
def test_the_material_of_pictures_is_found_live_and_again_after_a_stop(page, tmp_path):
    """Of a small picture of the page's own, whose error bars are 5 to 14%."""
    session = page._session
    start = session.start
    darker = tuple(1.5 * number for number in start.sigma_a)
    target = session.frame(dataclasses.replace(start, sigma_a=darker)).beauty
    camera, lights = session.camera(start), session.own.lights
    observation = sj.inverse.Observation(target, camera, lights)
    searching = Page(session, tmp_path, observations=[observation], port=18_090)
    press = searching._search.start
    press(searching._controls())
    searching._search.stop()
    wait_until(lambda: "stopped" in searching._stage.content)
    press(searching._controls())
    wait_until(lambda: "error bars" in searching._stage.content)
    powers = [searching._handles[f"sigma_a {channel}"].value for channel in (1, 2, 3)]
    np.testing.assert_allclose(powers, np.log2(1.5), atol=0.06)
    wait_until(lambda: searching._status.content == "")
    difference = searching._compared.image[:, SIDE:].astype(int) - 128
    assert np.abs(difference).max() <= 1
    searching.close()


def test_a_browser_orbits_drags_and_saves(page, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium")
    start, image = page._place, page._image
    with playwright.sync_playwright() as driver:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        window = browser.new_page(viewport={"width": 900, "height": 500})
        window.goto(page.url)
        window.wait_for_selector("text=turn lights")
        wait_until(lambda: page._image.size == (SIDE, SIDE) and page._status.content == "")
        window.wait_for_timeout(3000)
        picture = Image.open(io.BytesIO(window.screenshot())).convert("RGB")
        middle = picture.crop((200, 0, 700, 500)).resize((SIDE, SIDE), Image.Resampling.BOX)
        seen, made = (np.asarray(each, float) for each in (middle, page._image))
        shown = np.abs(seen - made)[:, 11:34]  # between a note of viser and the panel
        assert shown.mean() < SHOWN
        window.mouse.move(200, 250)
        window.mouse.down()
        window.mouse.move(260, 250, steps=5)
        window.mouse.up()
        wait_until(lambda: np.abs(page._place - start).max() > 5)
        window.get_by_role("button", name="PNG", exact=True).click()
        wait_until(lambda: [*tmp_path.rglob("studio_000.png")])
        browser.close()
    assert page._image is not image
