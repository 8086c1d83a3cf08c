"""The body of a session, and its most recent results."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import equinox as eqx
import jax

from splatjax.render import RenderSettings
from splatjax.scene import AbstractLight, EnvironmentLight, Splats

Kept = TypeVar("Kept")


class Body:
    """Splats, lights and picture size, with the most recent result of each kind.

    **Arguments:**

    - `settings`: layers that any weights can blend are kept only for the default settings.
    """

    def __init__(
        self,
        splats: Splats,
        lights: tuple[AbstractLight, ...],
        width: int,
        height: int,
        settings: RenderSettings = RenderSettings(),
    ):
        self.splats, self.lights, self.size = splats, lights, {"width": width, "height": height}
        self.settings = settings
        self.is_blended = eqx.tree_equal(settings, RenderSettings())
        self.kept: dict[str, tuple[Hashable, Any]] = {}
        self.is_in_environments = all(isinstance(light, EnvironmentLight) for light in lights)
        # Directions that do not turn with the image keep their shadows.
        self.keeps_shadows = all(getattr(light, "directions", None) is not None for light in lights)

    def has(self, kind: str, depends_on: Hashable) -> bool:
        return self.kept.get(kind, (None,))[0] == depends_on

    def keep(self, kind: str, depends_on: Hashable, make: Callable[[], Kept]) -> Kept:
        if not self.has(kind, depends_on):
            self.kept.pop(kind, None)  # before there are two
            self.kept[kind] = depends_on, jax.block_until_ready(make())
        return self.kept[kind][1]

    def planned(self, make: Callable[[], Any]) -> Any:
        """Render, with a new plan if the kept one does not suffice."""
        rendered = make()
        if rendered.overflow > 0:
            self.kept.clear()
            rendered = make()
        return rendered
