"""Maps of parameters of the material over the body, such as melanin and blood."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._records import as_floats, check_values
from splatjax.fitting import WeightTable
from splatjax.scene import Material, Splats

from ._observation import PicturedScene
from ._offsets import SurfaceMean
from ._parts import BOUNDED, AbstractPart

_SAME = 1e-5  # relative, between the Gaussians of the table and those of the material


class MapTables(eqx.Module):
    """The table in the precision of the splats, the mean over neighbors, the logits of the start,
    and the change of logits per coordinate.
    """

    table: WeightTable
    mean: SurfaceMean
    start: Float[Array, "splats parameters"]
    steps: Float[Array, "splats parameters parameters"]


class ParameterMap(AbstractPart):
    r"""The parameters of the material at every splat, within the range of a table, no finer than
    `smoothness`.

        fraction = 1 / (1 + exp(-(logit(start) + blur(B x))))

    The fraction is the position of a value in the range of its parameter, on the parameter's scale.
    The blur is a Gaussian mean over the surface. `B` is the inverse root of `J^T J / step^2 + 1 /
    deviation^2`, where `J` contains the derivatives, at the start and with respect to the logits,
    of the reflectance of a flat surface, divided by its mean over the channels. One coordinate
    therefore changes the color by about one step, in directions that are independent where
    parameters have similar effects. A splat farther than 2.5 `smoothness` from all visible ones
    keeps its start.

    The part replaces `Splats.weights`. An albedo of the same splats must be known.

    **Attributes:**

    - `table`: the factors of the parameters, on the Gaussians of the material.
    - `start`: values of each parameter by its name, one for each splat or one for all.
    - `smoothness`: standard deviation of the blur, mm. Static. If it is wider than half the spacing
      of the splats, maps become smoother, and fits slower.
    - `deviation`: expected distance of a logit from its start, one standard deviation of a normal
      prior; 2 covers nearly the whole range. Static.
    - `step`: relative change of the color for a coordinate of 1. Static.

    **Raises:** `ValueError` for parameters of other names, and for a start outside of the table.
    """

    shared = True
    table: WeightTable
    start: Mapping[str, Any]
    smoothness: float = eqx.field(static=True)
    deviation: float = eqx.field(static=True, default=2.0)
    step: float = eqx.field(static=True, default=0.02)

    def __check_init__(self):
        self.table.fractions(self.start)

    def check_material(self, material: Material) -> None:
        for name in ("variances", "weights"):
            ours, given = (
                np.asarray(getattr(gaussians, name), np.float64)
                for gaussians in (self.table.base, material.gaussians)
            )
            same = ours.shape == given.shape and np.allclose(ours, given, rtol=_SAME, atol=0)
            check_values(
                f"material.gaussians.{name}",
                float(same),
                "that of ParameterMap.table.base",
                lambda x: x == 1,
            )

    def prepared(self, splats: Splats) -> MapTables:
        table = jax.tree.map(lambda x: as_floats(np.asarray(x), splats.centers.dtype), self.table)
        fractions = np.asarray(table.fractions(self.start), np.float64).clip(BOUNDED, 1 - BOUNDED)
        logits = np.broadcast_to(
            np.log(fractions / (1 - fractions)), (splats.count, len(table.names))
        )
        start = jnp.asarray(logits, splats.centers.dtype)
        slopes = np.asarray(_reflectance_slopes(table, start), np.float64)
        information = np.swapaxes(slopes, 1, 2) @ slopes / self.step**2
        sizes, axes = np.linalg.eigh(information + np.eye(len(table.names)) / self.deviation**2)
        steps = (axes / np.sqrt(sizes)[:, None]) @ np.swapaxes(axes, 1, 2)
        mean = SurfaceMean.of(splats, self.smoothness)
        return MapTables(table, mean, start, jnp.asarray(steps, start.dtype))

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "splats parameters"]:
        areas = pictured.splats.areas
        return jnp.zeros_like(areas, shape=(len(areas), len(self.table.names)))

    def moved(self, pictured: PicturedScene, x, prepared: MapTables) -> PicturedScene:
        weights = prepared.table.interpolate(self._fractions(x, prepared))
        splats = dataclasses.replace(pictured.splats, weights=weights)
        return dataclasses.replace(pictured, splats=splats)

    def prior_residuals(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return prepared.mean.gain / self.deviation * _changes(x, prepared)

    def maps(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return prepared.table.values(self._fractions(x, prepared))

    def _fractions(self, x: Float[Array, "splats parameters"], prepared: MapTables):
        return jax.nn.sigmoid(prepared.start + prepared.mean(_changes(x, prepared)))


def _changes(x: Float[Array, "splats parameters"], prepared: MapTables):
    """Compute the changes of logits before the blur."""
    return jnp.einsum("spq,sq->sp", prepared.steps, x)


@eqx.filter_jit
def _reflectance_slopes(
    table: WeightTable, logits: Float[Array, "splats parameters"]
) -> Float[Array, "splats channels parameters"]:
    """Differentiate the reflectance with respect to the logits, and divide by its mean."""

    def reflectance(logits):
        return table.reflectance(jax.nn.sigmoid(logits)[None])[0]

    means = jnp.mean(jax.vmap(reflectance)(logits), axis=1)
    return jax.vmap(jax.jacfwd(reflectance))(logits) / means[:, None, None]
