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
# # Figure 7: earlier point-based methods and this one
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 7, from the
# built-in bust. `splatjax figure 7 --output figure_7.png` makes it larger, and from scanned heads;
# `docs/figures.md` says what to see.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines, plots

# %% [markdown]
# A bust of a third of life size, so that few splats resolve what light does in skin, under one
# light with shadows. Elliptical points are flat, splats that are blended are smooth, scattering is
# soft.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=192, height=192)
bust = plots.Subject("bust", sj.bust(20_000), (light,), camera).scaled(0.3)
skin = sj.load_material("skin")
plots.figure_7(bust, skin)

# %% [markdown]
# In numbers: how rough the light is, as the mean step from pixel to pixel inside the bust.


# %%
def roughness(material, settings=None):
    (frame,) = bust.drawn(material, settings)
    inside = np.asarray(frame.coverage) > 0.99
    luminance = np.asarray(frame.beauty).mean(axis=2)
    steps, both = np.abs(np.diff(luminance, axis=1)), inside[:, 1:] & inside[:, :-1]
    return float(steps[both].mean())


flat = roughness(skin.opaque(), baselines.elliptical_points())
blended = roughness(skin.opaque(), baselines.deferred_splatting())
soft = roughness(skin, None)
print(f"elliptical points {flat:.4f}, deferred splatting {blended:.4f}, with scattering {soft:.4f}")

# %%
assert flat > 1.3 * blended > 1.3 * soft
