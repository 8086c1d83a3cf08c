"""What is drawn, and what was computed of it last."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import jax

from splatjax.scene import AbstractLight, EnvironmentLight, Splats

Kept = TypeVar("Kept")


class Body:
    """Splats, lights, the size of their picture, and what was computed of them last, one of each
    kind.
    """

    def __init__(self, splats: Splats, lights: tuple[AbstractLight, ...], width: int, height: int):
        self.splats, self.lights, self.size = splats, lights, {"width": width, "height": height}
        self.kept: dict[str, tuple[Hashable, Any]] = {}
        environments = [light for light in lights if isinstance(light, EnvironmentLight)]
        self.is_in_environments = len(environments) == len(lights)
        # Directions that do not turn with the image keep their shadows.
        self.keeps_shadows = self.is_in_environments and all(
            light.directions is not None for light in environments
        )

    def has(self, kind: str, depends_on: Hashable) -> bool:
        return self.kept.get(kind, (None,))[0] == depends_on

    def keep(self, kind: str, depends_on: Hashable, make: Callable[[], Kept]) -> Kept:
        if not self.has(kind, depends_on):
            self.kept.pop(kind, None)  # before there are two
            self.kept[kind] = depends_on, jax.block_until_ready(make())
        return self.kept[kind][1]
