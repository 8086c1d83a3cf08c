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
# # Figure 6: other materials
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 6, from the
# built-in bust. `splatjax figure 6 --scene head.ply --output figure_6.png` makes it larger, and
# from scanned heads too; `docs/figures.md` says what to see.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import plots

# %% [markdown]
# A bust of a third of life size, so that few splats resolve what light does in skin, under one
# light with shadows.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=192, height=192)
bust = plots.Subject("bust", sj.bust(20_000), (light,), camera).scaled(0.3)
skin = sj.load_material("skin")
materials = {
    "skin": skin,
    "marble": sj.load_material("marble"),
    "ketchup": sj.load_material("ketchup"),
}
plots.figure_6([bust], materials)

# %% [markdown]
# In numbers: the color of each material, red over blue, as its profile has it and as the picture
# shows it.

# %%
plain = bust.without_albedo()
shown, told = {}, {}
for name in ("marble", "ketchup"):
    (frame,) = plain.drawn(materials[name])
    whole = np.asarray(frame.diffuse).sum(axis=(0, 1))
    weights = np.asarray(materials[name].gaussians.weights).sum(axis=0)
    shown[name], told[name] = whole[0] / whole[2], weights[0] / weights[2]
    print(
        f"{name}: red over blue {shown[name]:.2f} in the picture, {told[name]:.2f} in the profile"
    )

# %%
for name, ratio in shown.items():
    np.testing.assert_allclose(ratio, told[name], rtol=0.15)
assert shown["ketchup"] > 3 * shown["marble"]
