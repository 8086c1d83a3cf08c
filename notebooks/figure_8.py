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
# # Figure 8: half by texture-space diffusion, half by splats
#
# "Subsurface scattering using splat-based diffusion in point-based rendering", Figure 8, from the
# built-in bust. `splatjax figure 8 --output figure_8.png` makes it larger, and from meshes with
# texture coordinates; `docs/figures.md` says what to see.

# %%
# %matplotlib inline
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines, plots
from splatjax.geometry import sample_mesh

# %% [markdown]
# The head of the bust at a third of life size. Its chart is longitude and latitude seen from
# inside, and its ears overlap there.

# %%
eye, middle = jnp.asarray([400.0, 30.0, 820.0]), jnp.asarray([0.0, 0.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=17.0, width=192, height=192)
mesh, textures = baselines.bust_with_textures(512)
splats = sample_mesh(mesh, 40_000, textures=textures)
bust = plots.Subject("bust", splats, (light,), camera).scaled(0.3)
triangles = baselines.TexturedMesh.of(mesh, textures)
triangles = replace(triangles, vertices=0.3 * triangles.vertices)
skin = sj.load_material("skin")

# %% [markdown]
# Left of the line triangles with texture-space diffusion, right of it splats.

# %%
plots.figure_8(bust, triangles, skin)

# %% [markdown]
# In numbers: how far the two are apart inside the head, of the picture's root mean square.

# %%
scene = bust.scene(skin)
ours = sj.render(scene, bust.camera)
theirs = baselines.render_texture_space(triangles, scene.lights, scene.material, bust.camera).frame
inside = (np.asarray(ours.coverage) > 0.99) & (np.asarray(theirs.coverage) > 0.99)
a, b = (np.asarray(frame.beauty)[inside] for frame in (ours, theirs))
apart = np.abs(a - b).max(axis=1) / np.sqrt(np.mean(a**2))
print(
    f"apart by {np.median(apart):.4f} at the median, {np.quantile(apart, 0.9):.3f} in one pixel of "
    "ten"
)

# %%
assert np.median(apart) < 0.02
assert np.quantile(apart, 0.9) < 0.1
