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
# # Figure 4: the layers of a picture
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 4, from the
# built-in bust. `splatjax figure 4 --output figure_4.png` makes it larger, and from scanned heads;
# `docs/figures.md` says what to see.

# %%
# %matplotlib inline
import itertools

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import plots

# %% [markdown]
# A bust of a seventh of life size, so that few splats resolve what light does in skin, under one
# light with shadows. Blue and green stay where they enter, red travels.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=192, height=192)
bust = plots.Subject("bust", sj.bust(20_000), (light,), camera).scaled(0.15)
skin = sj.load_material("skin")
plots.figure_4(bust, skin)

# %% [markdown]
# In numbers: how rough each layer is, as the mean step from pixel to pixel inside the bust.


# %%
def roughness(picture, inside):
    """Give the mean step from pixel to pixel inside the body."""
    both = inside[:, 1:] & inside[:, :-1]
    return float(np.abs(np.diff(picture, axis=1))[both].mean())


(frame,) = bust.drawn(skin)
inside = np.asarray(frame.coverage) > 0.99
steps = [roughness(np.asarray(layer).mean(axis=2), inside) for layer in frame.layers]
print("steps of the layers:", np.round(steps, 4))

# %%
assert all(narrow >= wide for narrow, wide in itertools.pairwise(steps))
assert steps[0] > 1.3 * steps[-1]
