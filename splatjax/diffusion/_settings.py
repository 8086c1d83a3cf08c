"""What pass 4 leaves to choose."""

import equinox as eqx

from ._normalization import AbstractNormalization, ExitOdds


class DiffusionSettings(eqx.Module):
    r"""How layers are normalized, and where one is too narrow for the splats. Lengths in spacings
    (the root of a splat's area).

    Below some width, in standard deviations per spacing, a layer is the surface's own irradiance;
    from another on it is the diffusion integral, in between a smooth blend. Splats on a regular
    grid carry narrower layers than scattered ones.

    **Attributes:**

    - `regular`, `scattered`: both widths, on a regular grid and for splats at random. Static.
    - `normalization`: what the light that a splat gathers is divided by.
    """

    regular: tuple[float, float] = eqx.field(static=True, default=(0.4, 0.8))
    scattered: tuple[float, float] = eqx.field(static=True, default=(1.0, 2.0))
    normalization: AbstractNormalization = ExitOdds()
