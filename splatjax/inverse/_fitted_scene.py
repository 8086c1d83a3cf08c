"""A scene that was fitted to pictures, and how it came about."""

import equinox as eqx
import numpy as np
import optimistix as optx
from jaxtyping import Float

from splatjax.scene import AbstractLight, Camera, Material, Scene, Splats


class FittedScene(eqx.Module):
    r"""The best that a fit came by.

    **Attributes:**

    - `splats`: the body.
    - `cameras`, `lights`: of each picture.
    - `material`: as it was given.
    - `losses`: at the start and after each step: sum of the losses of all pixels and of what the
      priors add, over the number of values that count. About 1 where what is left is noise.
    - `best`: the step with the least of them, which all else here is of. Static.
    - `plans`: how many times was planned, once for the start. Static.
    - `pictures`: what the renderer makes of it; NaN where a pixel does not count.
    - `residuals`: pictures less what was observed.
    - `result`: what became of it, as a message (`optimistix.RESULTS`).
    """

    splats: Splats
    cameras: tuple[Camera, ...]
    lights: tuple[tuple[AbstractLight, ...], ...]
    material: Material
    losses: Float[np.ndarray, " steps"]
    pictures: tuple[Float[np.ndarray, "_ _ channels"], ...]
    residuals: tuple[Float[np.ndarray, "_ _ channels"], ...]
    result: optx.RESULTS
    best: int = eqx.field(static=True)
    plans: int = eqx.field(static=True)

    def scene(self, picture: int = 0) -> Scene:
        """Return the scene of a picture."""
        return Scene(self.splats, self.lights[picture], self.material)
