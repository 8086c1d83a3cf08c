"""The smooth step."""


def smooth_step(x, low, high):
    """Compute 0 below `low`, 1 above `high`, a cubic between; reversed when `low > high`. Of arrays
    of NumPy or JAX.
    """
    t = ((x - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)
