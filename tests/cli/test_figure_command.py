"""`splatjax figure`: each figure is made from a body of one's own, and what cannot be made is
said.
"""

import numpy as np
import pytest
from commands import ball, failure
from PIL import Image

from splatjax.cli import main


@pytest.mark.once
def test_figure_3_needs_no_body(tmp_path):
    output = tmp_path / "figure.png"
    assert main(["figure", "3", "--material", "marble", "--output", str(output)]) == 0
    with Image.open(output) as picture:
        assert np.std(np.asarray(picture.convert("L"), float)) > 10


@pytest.mark.long
@pytest.mark.once
@pytest.mark.parametrize("number", [1, 4, 5, 6, 7])
def test_every_figure_is_made_from_a_ball(tmp_path, number):
    body, output = ball(tmp_path / "ball.ply", radius=60.0, count=2500), tmp_path / "figure.png"
    words = [
        "figure",
        str(number),
        "--scene",
        str(body),
        "--output",
        str(output),
        "--width",
        "48",
        "--count",
        "3000",
    ]
    assert main([*words, *(["--materials", "skin", "marble"] if number == 6 else [])]) == 0
    with Image.open(output) as picture:
        assert np.std(np.asarray(picture.convert("L"), float)) > 10


@pytest.mark.long
@pytest.mark.once
def test_figure_8_is_made_from_the_bust(tmp_path):
    output = tmp_path / "figure.png"
    assert main(["figure", "8", "--output", str(output), "--width", "48", "--count", "3000"]) == 0
    with Image.open(output) as picture:
        assert np.std(np.asarray(picture.convert("L"), float)) > 10


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["2"], "no figure 2"),
        (["3", "--albedo", "nowhere.jpg"], "--albedo is of the mesh of figure 8"),
        (["8", "--scene", "nowhere.glb"], "--mm-per-unit"),
        (["8", "--scene", "nowhere.glb", "--mm-per-unit", "53"], "nowhere.glb"),
        (["1", "--scale", "0"], "--scale"),
        (["1", "--output", "figure.exr"], ".png"),
        (["1", "--scene", "nowhere.ply"], "nowhere.ply"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path, capsys, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    assert says in failure(["figure", *words], capsys, [tmp_path / "figure.png"])
