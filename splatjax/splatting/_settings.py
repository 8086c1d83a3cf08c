"""What passes 2 and 3 leave to choose."""

import equinox as eqx


class SplattingSettings(eqx.Module):
    r"""How splats become a surface. All static.

    **Attributes:**

    - `filter_radius`: of the screen filter, pixels, positive. At the root of 2 the weights of a
      splat smaller than a pixel add up to the same over the pixels, wherever it lies between them,
      to 4%.
    - `epsilon_z`: fragments within this many radii behind the front belong to it (3.1).
    - `largest_slope`: slanted splats have epsilon lengthened by `1 / cos`, up to this factor.
    - `full_coverage`: weight sum from which on a pixel is covered. Splats whose radius is 1.5 times
      the root of their area, scattered at random, have at least 0.2 inside a closed surface.
    """

    filter_radius: float = eqx.field(static=True, default=2**0.5)
    epsilon_z: float = eqx.field(static=True, default=1.5)
    largest_slope: float = eqx.field(static=True, default=3.0)
    full_coverage: float = eqx.field(static=True, default=0.15)
