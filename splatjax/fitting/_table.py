"""Factors of the weights of a sum of Gaussians as a function of material parameters, tabulated and
interpolated by splines.
"""

import itertools
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # submodules load on first use
from jaxtyping import Array, Float

from splatjax._records import Numbers, as_floats, check_values, require
from splatjax.gaussians import AbstractProfile, SumOfGaussians

from ._models import weight_factors

_MOST = 3  # largest number of parameters


class WeightTable(eqx.Module):
    r"""Factors of the weights of a base material, at the nodes of a grid of parameters.

    Cubic splines along each parameter interpolate the square roots of the factors and of the total
    reflectance; the factors of a channel are then scaled to its total. The factors are exact at
    nodes, never negative, and have continuous slopes. The scale of a parameter is logarithmic if
    its nodes are positive, and otherwise linear.

    **Attributes:** (made by `weight_table`)

    - `names`: names of the parameters; `logarithmic`: whether the scale of each is logarithmic.
      Static.
    - `base`: the Gaussians of the scene's material, whose weights the factors multiply.
    - `limits`: the least and the largest value of each parameter.
    - `knots`: the nodes of each parameter, as fractions of its range on its scale.
    - `slopes`: slopes, at all knots, of the splines that are 1 at one knot and 0 at the others.
    - `at_nodes`: the factors at the grid nodes; the last parameter varies fastest.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    base: SumOfGaussians
    limits: Float[Array, "parameters 2"]
    knots: tuple[Float[Array, " _knots"], ...]
    slopes: tuple[Float[Array, "_knots _knots"], ...]
    at_nodes: Float[Array, "grid gaussians channels"]

    def factors(self, values: Mapping[str, Numbers]) -> Float[Array, "splats gaussians channels"]:
        """Interpolate the factors for each splat, for `Splats.weights`.

        **Arguments:**

        - `values`: values of each parameter by name, one per splat or one for all. Differentiable.

        **Raises:** `ValueError` for other names of parameters, and for a value outside the table.
        """
        return self.interpolate(self.fractions(values))

    def fractions(self, values: Mapping[str, Numbers]) -> Float[Array, "splats parameters"]:
        """Check values, and compute their positions in the ranges of the parameters, 0 to 1."""
        require(
            set(values) == set(self.names),
            f"values are given for {', '.join(values)}; give {', '.join(self.names)}",
        )
        rows = [as_floats(values[name], self.at_nodes.dtype, name) for name in self.names]
        slack = 16 * float(jnp.finfo(self.at_nodes.dtype).eps)  # rounding of `values`
        for name, row, (low, high) in zip(self.names, rows, np.asarray(self.limits), strict=True):
            limits = f"between {low:g} and {high:g}, the range of the table"
            low, high = low - slack * abs(low), high + slack * abs(high)
            check_values(name, row, limits, lambda x, low=low, high=high: (x >= low) & (x <= high))
        points = jnp.stack(jnp.broadcast_arrays(*map(jnp.atleast_1d, rows)), axis=1)
        low, high = self._scaled(self.limits.T)
        return (self._scaled(points) - low[None]) / (high - low)[None]

    def values(self, fractions: Float[Array, "splats parameters"]) -> dict[str, Array]:
        """Compute parameter values from fractions of their ranges. This is the inverse of
        `fractions`.
        """
        low, high = self._scaled(self.limits.T)
        rows = (low[None] + (high - low)[None] * fractions).T
        return {
            name: jnp.exp(row) if is_logarithmic else row
            for name, is_logarithmic, row in zip(self.names, self.logarithmic, rows, strict=True)
        }

    def interpolate(
        self, fractions: Float[Array, "splats parameters"]
    ) -> Float[Array, "splats gaussians channels"]:
        """Interpolate the factors at fractions of the ranges. Differentiable."""
        shares = jnp.ones_like(fractions[:, :1])
        for knots, slopes, column in zip(self.knots, self.slopes, fractions.T, strict=True):
            own = _spline_shares(knots, slopes, column)
            shares = (shares[:, :, None] * own[:, None]).reshape(len(fractions), -1)
        roots, totals = jnp.sqrt(self.at_nodes), jnp.sqrt(self._totals(self.at_nodes))
        factors = jnp.maximum(jnp.tensordot(shares, roots, 1), 0.0) ** 2
        sums = self._totals(factors)
        return factors * ((shares @ totals) ** 2 / jnp.where(sums > 0, sums, 1.0))[:, None]

    def reflectance(
        self, fractions: Float[Array, "splats parameters"]
    ) -> Float[Array, "splats channels"]:
        """Compute the total reflectance of flat surfaces at fractions of the ranges."""
        return self._totals(self.interpolate(fractions))

    def _totals(self, factors: Float[Array, "points gaussians channels"]):
        return jnp.sum(self.base.weights[None] * factors, axis=1)

    def _scaled(self, points: Float[Array, "points parameters"]):
        columns = zip(points.T, self.logarithmic, strict=True)
        return jnp.stack([jnp.log(column) if is_log else column for column, is_log in columns], 1)


def _spline_shares(
    knots: Float[Array, " knots"], slopes: Float[Array, "knots knots"], x: Float[Array, " points"]
) -> Float[Array, "points knots"]:
    """Compute the weight of each knot in a spline, by cubic Hermite polynomials."""
    cell = jnp.clip(jnp.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    width, unit = (knots[cell + 1] - knots[cell])[:, None], jnp.eye(len(knots), dtype=knots.dtype)
    t = (x - knots[cell])[:, None] / width
    of_values = (1 + 2 * t) * (1 - t) ** 2 * unit[cell] + t * t * (3 - 2 * t) * unit[cell + 1]
    return of_values + width * t * (1 - t) * ((1 - t) * slopes[cell] - t * slopes[cell + 1])


def weight_table(
    profile_of: Callable[..., AbstractProfile],
    nodes: Mapping[str, Numbers],
    base: SumOfGaussians,
) -> WeightTable:
    r"""Tabulate the factors that convert the weights of a base material to those of a material with
    one to three parameters, such as melanin and blood.

        def skin(melanin, blood):
            return sj.scattering.Skin(melanin, blood, wavelengths=(620, 550, 460)).profile()

        nodes = {"melanin": np.geomspace(0.01, 0.4, 9), "blood": np.geomspace(0.002, 0.1, 7)}
        table = sj.fitting.weight_table(skin, nodes, base)
        splats = replace(splats, weights=table.factors({"melanin": freckles, "blood": 0.01}))

    Each node is one fit of weights (`weight_factors`). For the table above, total reflectances
    between nodes differ from those of the profile by at most 1%, and typically by 0.02%.

    **Arguments:**

    - `profile_of`: computes the profile from a value of each parameter, passed by name, in double
      precision.
    - `nodes`: ascending values of each parameter, by name. Choose them denser where the profile
      changes faster.
    - `base`: the Gaussians of the scene's material. A weight of 0 stays 0, so fit the base to the
      widest profile, which has the least absorption.

    **Returns:** a `WeightTable`, in the precision of the base.

    **Raises:** `ValueError` for more than three parameters or none, and for fewer than two nodes or
    nodes that do not ascend.
    """
    require(1 <= len(nodes) <= _MOST, f"nodes has {len(nodes)} parameters; give one to {_MOST}")
    grid = {name: np.asarray(values, np.float64) for name, values in nodes.items()}
    for name, values in grid.items():
        require(
            values.ndim == 1 and len(values) > 1 and np.all(np.diff(values) > 0),
            f"nodes[{name!r}] must be two or more ascending numbers; got {values}",
        )
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), base)
        factors = [
            np.asarray(weight_factors(exact, profile_of(**dict(zip(grid, point, strict=True)))))
            for point in itertools.product(*(values.tolist() for values in grid.values()))
        ]
    logarithmic = [bool(values[0] > 0) for values in grid.values()]
    scaled = [
        np.log(values) if is_logarithmic else values
        for values, is_logarithmic in zip(grid.values(), logarithmic, strict=True)
    ]
    knots = [(values - values[0]) / (values[-1] - values[0]) for values in scaled]
    slopes = [scipy.interpolate.CubicSpline(x, np.eye(len(x)))(x, 1) for x in knots]
    limits = np.stack([values[[0, -1]] for values in grid.values()])
    arrays = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, base.weights.dtype),
        (limits, tuple(knots), tuple(slopes), np.stack(factors)),
    )
    return WeightTable(tuple(grid), tuple(logarithmic), base, *arrays)
