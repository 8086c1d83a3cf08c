"""The studio in a cell of a notebook, driven as a browser drives it: by values and events."""

import asyncio
import dataclasses

import ipywidgets
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatjax as sj
from splatjax.studio import Session, widget

EVENT = {"buttons": (1,), "type": "pointer_move"}


@pytest.fixture
def shown(studio, tmp_path):
    return widget(Session(studio.own, studio.camera(studio.start), [0, 0, 0]), tmp_path / "saved")


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


def test_a_widget_shows_the_picture_of_its_controls(shown, studio):
    assert shown.controls == studio.start
    next(s for s in parts(shown) if getattr(s, "description", "") == "all").value = 1.0
    found(shown, ipywidgets.FloatSlider, "exposure, stops").value = 0.5
    doubled = tuple(2 * number for number in studio.start.sigma_a)
    assert shown.controls == dataclasses.replace(studio.start, sigma_a=doubled, exposure=0.5)
    draft, picture = drawn(shown)
    session = Session(studio.own, studio.camera(studio.start), [0, 0, 0])
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
