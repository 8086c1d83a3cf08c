"""Where fits of dipoles start: variances of the best fits, tabulated once."""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float

from splatjax.scattering import Medium

from ._search import GivenVariances


class DipoleStarts(eqx.Module):
    r"""Variances of the best fits to dipoles, per channel, over reduced albedo and index of
    refraction.

    Counted in squared mean free paths they depend on nothing else. They are tabulated over `sqrt(1
    - alpha')`, in which they are smooth, and interpolated linearly in their logarithms; beyond the
    table's ends the last entry serves.

    **Attributes:**

    - `roots`: of `1 - alpha'`, equally spaced.
    - `etas`: equally spaced.
    - `log_variances`: one array per number of Gaussians, from 1 on.
    """

    roots: Float[Array, " roots"]
    etas: Float[Array, " etas"]
    log_variances: tuple[Float[Array, "roots etas _"], ...]

    def __call__(self, medium: Medium, count: int) -> GivenVariances:
        r"""Compute the start of a fit of `count` Gaussians to `Dipole(medium)` with
        `VariancesPerChannel()`.

        **Raises:** `ValueError` for more Gaussians than the table has.
        """
        if not 1 <= count <= len(self.log_variances):
            raise ValueError(
                f"starts are tabulated for 1 to {len(self.log_variances)} Gaussians; got {count}"
            )
        dtype = medium.eta.dtype
        root = jnp.sqrt(medium.sigma_a / medium.sigma_t_prime)
        place = [_place(self.roots, root), _place(self.etas, medium.eta)]
        table = self.log_variances[count - 1].astype(dtype)
        columns = [
            map_coordinates(table[..., i], place, order=1, mode="nearest") for i in range(count)
        ]
        length = 1 / medium.sigma_t_prime
        return GivenVariances(jnp.exp(jnp.stack(columns, axis=-1)) * (length * length)[:, None])


def _place(
    nodes: Float[Array, " nodes"], values: Float[Array, " channels"]
) -> Float[Array, " channels"]:
    """Locate values among equally spaced nodes, in steps."""
    nodes = nodes.astype(values.dtype)
    return (values - nodes[0]) / (nodes[1] - nodes[0])
