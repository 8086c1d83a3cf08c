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
# Figure 8 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` describes it, and shows how to
# use another mesh with texture coordinates.

# %%
# %matplotlib inline
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines
from splatjax.geometry import sample_mesh
from splatjax.io import srgb_to_linear
from splatjax.plots import plot_pictures

# %% [markdown]
# The body is the head of the bust, scaled to 0.3 of its size. Its texture coordinates are longitude
# and latitude about a point inside, so the ears overlap the head in texture space.

# %%
SCALE, SIZE = 0.3, 256
mesh, textures = baselines.bust_with_textures(512)
triangles = baselines.TexturedMesh.of(mesh, textures)
triangles = replace(triangles, vertices=SCALE * triangles.vertices)
splats = sample_mesh(mesh, 40_000, textures=textures).scaled(SCALE)
low, high = jnp.min(splats.centers, axis=0), jnp.max(splats.centers, axis=0)
eye = (low + high) / 2 + (high[1] - low[1]) * jnp.asarray([1.3, 0.1, 2.7])
camera = sj.Camera.look_at(eye, (low + high) / 2, fov=22.0, width=SIZE, height=SIZE)
lights = (
    sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi)),
    sj.DirectionalLight(jnp.asarray([-0.7, -0.2, -0.7]), jnp.full(3, 0.3), cast_shadows=False),
)
skin = sj.load_material("skin").white()

# %% [markdown]
# The left half is rendered as triangles with texture-space diffusion and four samples per pixel,
# the right half as splats. The picture beside it shows the difference, splats minus triangles,
# amplified eight times around middle gray.

# %%
settings = sj.RenderSettings(kernel=sj.diffusion.PlainMean())  # as in texture space
ours = sj.render(sj.Scene(splats, lights, skin), camera, settings)
finer = replace(camera, width=2 * SIZE, height=2 * SIZE)
theirs = baselines.render_texture_space(triangles, lights, skin, finer).frame
beauty, coverage = (
    np.asarray(layer).reshape(SIZE, 2, SIZE, 2, -1).mean(axis=(1, 3))
    for layer in (theirs.beauty, theirs.coverage)
)
white = float(np.quantile(ours.beauty, 0.995))
halves = np.concatenate([beauty[:, : SIZE // 2], ours.beauty[:, SIZE // 2 :]], axis=1) / white
difference = 0.5 + 8 * (np.asarray(ours.beauty, np.float64) - beauty) / white
plot_pictures(
    [[halves, srgb_to_linear(np.clip(difference, 0, 1))]],
    ["texture-space diffusion, splats", "difference, enlarged 8 times"],
    white=1.0,
    inches=4.2,
)

# %% [markdown]
# The number is the difference inside the head, relative to the root mean square of the picture.

# %%
inside = (np.asarray(ours.coverage) > 0.99) & (coverage[..., 0] > 0.99)
a, b = np.asarray(ours.beauty)[inside], beauty[inside]
apart = np.abs(a - b).max(axis=1) / np.sqrt(np.mean(a**2))
print(
    f"apart by {np.median(apart):.4f} at the median, {np.quantile(apart, 0.9):.3f} in one pixel of "
    "ten"
)

# %%
assert np.median(apart) < 0.02
assert np.quantile(apart, 0.9) < 0.1
