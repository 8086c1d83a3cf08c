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
# # Figure 1: splats, the surface they make, and light below it
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 1, from the
# built-in bust. `splatjax figure 1 --output figure_1.png` makes it larger, and from scanned heads;
# `docs/figures.md` says what to see.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines, plots

# %% [markdown]
# A bust of a third of life size, so that few splats resolve what light does in skin, under one
# light with shadows.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=192, height=192)
bust = plots.Subject("bust", sj.bust(20_000), (light,), camera).scaled(0.3)
skin = sj.load_material("skin")
plots.figure_1(bust, skin, discs=3000)

# %% [markdown]
# In numbers: how much light there is where none falls, because the surface turns away or lies in
# shadow. What scatters gets there.

# %%
(opaque,) = bust.drawn(skin.opaque(), baselines.deferred_splatting())
(soft,) = bust.drawn(skin)
unlit = (np.asarray(soft.coverage) > 0.99) & (np.asarray(opaque.diffuse).max(axis=2) < 1e-4)
reached = float(np.asarray(soft.diffuse)[unlit].mean() / np.asarray(soft.diffuse)[~unlit].mean())
share = np.asarray(soft.diffuse)[unlit].sum(axis=0)
print(
    f"{unlit.sum()} pixels have no light of their own; scattering brings {100 * reached:.1f}% of "
    "the rest's there, mostly red"
)

# %%
assert unlit.sum() > 100
assert reached > 0.003
assert share[0] > 1.5 * share[2]
