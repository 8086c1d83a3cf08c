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

    - `settings`: settings of the renderer. Layers for arbitrary weights are kept only with the
      default settings.
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
        # Fixed directions keep their shadows when the image turns.
        self.keeps_shadows = all(getattr(light, "directions", None) is not None for light in lights)

    def has(self, kind: str, depends_on: Hashable) -> bool:
        return self.kept.get(kind, (None,))[0] == depends_on

    def keep(self, kind: str, depends_on: Hashable, make: Callable[[], Kept]) -> Kept:
        if not self.has(kind, depends_on):
            self.kept.pop(kind, None)  # free the old result first
            self.kept[kind] = depends_on, jax.block_until_ready(make())
        return self.kept[kind][1]

    def planned(self, make: Callable[[], Any]) -> Any:
        """Call `make`, again with a new plan if the kept plan does not suffice."""
        rendered = make()
        if rendered.overflow > 0:
            self.kept.clear()
            rendered = make()
        return rendered
