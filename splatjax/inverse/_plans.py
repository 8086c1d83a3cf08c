"""Plans for pictures of one body."""

from collections.abc import Sequence

import jax

from splatjax.render import Plan, RenderSettings, make_plan
from splatjax.scene import Camera, Scene


def plans_of(
    scenes: Sequence[Scene], cameras: Sequence[Camera], settings: RenderSettings
) -> list[Plan]:
    """Give a plan for each scene with its camera; pictures that may share one do, so that nothing
    is compiled twice.
    """
    alike: dict[object, list[int]] = {}
    for i, (camera, scene) in enumerate(zip(cameras, scenes, strict=True)):
        alike.setdefault(
            (camera.width, camera.height, *(jax.tree.structure(each) for each in scene.lights)), []
        ).append(i)
    found: list[Plan | None] = [None] * len(scenes)
    for places in alike.values():
        made = make_plan([scenes[i] for i in places], [cameras[i] for i in places], settings)
        for i in places:
            found[i] = made
    return [each for each in found if each is not None]
