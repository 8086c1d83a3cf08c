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
# # Figure 5: the wider the splats, the fewer of them do
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 5, from the
# built-in bust. `splatjax figure 5 --output figure_5.png` makes it larger, and from scanned heads;
# `docs/figures.md` has the law.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines, plots

# %% [markdown]
# Errors follow a law with one fitted factor.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=64, height=64)
few = plots.Subject("bust", sj.bust(8000), (light,), camera)
plots.figure_5(few, amplified=(2.0, 4.0, 8.0), keep=(1, 4, 16))

# %% [markdown]
# In numbers: how many splats a layer needs for an error of 2%. Twice as wide, it needs a quarter.

# %%
narrow, wide, error, contrast = (jnp.asarray(value) for value in (4.0, 8.0, 0.02, 0.5))
fewer = [
    float(baselines.splats_that_suffice(width, jnp.asarray(1.0), error, contrast))
    for width in (narrow, wide)
]
print(
    f"of the splats {100 * fewer[0]:.1f}% do for a layer 4 spacings wide, {100 * fewer[1]:.1f}% "
    "for one of 8"
)

# %%
np.testing.assert_allclose(fewer[0] / fewer[1], 4, rtol=1e-5)
