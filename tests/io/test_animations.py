"""Animations and the records of how they were made."""

import numpy as np
import pytest
from PIL import Image

from splatjax.io import fingerprint, read_record, write_animation, write_png, write_record


@pytest.fixture
def frames(tmp_path):
    """Three frames of noise."""
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        write_png(path, np.random.default_rng(i).uniform(0, 1, (6, 5, 3)))
    return paths


def test_animation_keeps_the_colors_and_the_time(tmp_path, frames):
    path = tmp_path / "film.webp"
    write_animation(path, frames, frames_per_second=24.0)
    with Image.open(path) as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (3, (5, 6), 0)
        durations = []
        for i, frame in enumerate(frames):
            film.seek(i)
            film.load()
            durations.append(film.info["duration"])
            with Image.open(frame) as image:
                np.testing.assert_array_equal(np.asarray(film.convert("RGB")), np.asarray(image))
    assert durations == [42, 41, 42]  # the third frame ends at 125 ms
    assert {each.name for each in tmp_path.iterdir()} == {"film.webp", "0.png", "1.png", "2.png"}


def test_animations_that_cannot_be_are_refused(tmp_path, frames):
    path = tmp_path / "film.webp"
    with pytest.raises(ValueError, match="needs a frame"):
        write_animation(path, [])
    with pytest.raises(ValueError, match=r"from 0\.1 to 60"):
        write_animation(path, frames, frames_per_second=0.0)
    write_png(frames[2], np.zeros((6, 6, 3)))
    with pytest.raises(ValueError, match=r"2\.png: is \(6, 6\) pixels"):
        write_animation(path, frames)
    assert not path.exists()


def test_one_frame_stands_still(tmp_path, frames):
    write_animation(tmp_path / "still.webp", frames[:1])
    with Image.open(tmp_path / "still.webp") as still:
        assert still.n_frames == 1


def test_record_comes_back(tmp_path):
    record = {"--frames": 12, "--fill": 0.1, "splats": None}
    write_record(tmp_path / "record.json", record)
    assert read_record(tmp_path / "record.json") == record
    for broken in ("{", "[]"):
        (tmp_path / "record.json").write_text(broken)
        with pytest.raises(ValueError, match=r"record\.json: is no .*delete it"):
            read_record(tmp_path / "record.json")


def test_fingerprint_tells_contents_apart(tmp_path):
    one, same, other = (tmp_path / name for name in ("one", "same", "other"))
    one.write_bytes(b"abc")
    same.write_bytes(b"abc")
    other.write_bytes(b"abd")
    assert fingerprint(one) == fingerprint(same) != fingerprint(other)
    assert fingerprint(one).startswith("3 bytes, SHA-256 ba7816bf")
