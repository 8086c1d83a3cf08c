# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Figure 3: a Gaussian on each splat, and the profile they add up to
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 3.
# `splatjax figure 3 --output figure_3.png` makes it larger; `docs/figures.md` says what to see.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import plots

# %%
skin = sj.load_material("skin").gaussians
plots.figure_3(skin, title="skin")

# %% [markdown]
# In numbers: how far light goes, as the root mean square of the distance in each channel. Red goes
# farthest.

# %%
reach = np.sqrt(
    2
    * np.asarray(
        jnp.sum(skin.weights * skin.variances[:, None], axis=0) / jnp.sum(skin.weights, axis=0)
    )
)
print("red, green and blue go", np.round(reach, 2), "mm")
radii = jnp.linspace(0, 8 * jnp.sqrt(skin.variances.max()), 20_001)
within = jnp.trapezoid(2 * jnp.pi * radii[:, None] * skin(radii), radii, axis=0)

# %%
assert reach[0] > 2 * reach[1] > 2 * reach[2]
np.testing.assert_allclose(within, jnp.sum(skin.weights, axis=0), rtol=1e-3)
