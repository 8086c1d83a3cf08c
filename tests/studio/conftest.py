from dataclasses import replace

import pytest

import splatjax as sj
from splatjax.studio import Session

SIDE = 48  # of the pictures, pixels


@pytest.fixture(scope="module")
def studio():
    splats = sj.bust(1500).scaled(0.1).without_maps()
    lights = [sj.DirectionalLight([1, -0.3, -1], 3.0), sj.PointLight([-30, 0, 60], 1e3)]
    camera = sj.Camera.look_at([20, 0, 70], [0, 0, 0], width=SIDE, height=SIDE)
    session = Session(sj.Scene(splats, lights, sj.load_material("marble")), camera, [0, 0, 0])
    session.picture(session.start)  # whose plan serves all changes
    return session


@pytest.fixture(scope="module")
def another(studio):
    """Return how to begin a session of the scene with some fields changed."""

    def begin(settings=sj.RenderSettings(), skin=None, **fields):
        scene, camera = replace(studio.own, **fields), studio.camera(studio.start)
        return Session(scene, camera, [0, 0, 0], settings=settings, skin=skin)

    return begin
