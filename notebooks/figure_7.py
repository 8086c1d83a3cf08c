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
# Figure 7 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` describes it.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines
from splatjax.plots import plot_pictures

# %% [markdown]
# The bust is scaled to 0.3 of its size, so that few splats resolve the diffusion of light in skin.
# One light casts shadows; a second, weak light does not.

# %%
body = sj.bust(40_000).scaled(0.3)
low, high = jnp.min(body.centers, axis=0), jnp.max(body.centers, axis=0)
eye = (low + high) / 2 + (high[1] - low[1]) * jnp.asarray([0.9, 0.1, 1.9])
camera = sj.Camera.look_at(eye, (low + high) / 2, fov=28.0, width=256, height=256)
lights = (
    sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi)),
    sj.DirectionalLight(jnp.asarray([-0.7, -0.2, -0.7]), jnp.full(3, 0.3), cast_shadows=False),
)
near = sj.Camera.look_at(
    eye, low + (high - low) * jnp.asarray([0.6, 0.56, 1.0]), fov=6.0, width=256, height=256
)
skin = sj.load_material("skin").white()

# %% [markdown]
# Elliptical points look flat, blended splats look smooth, and scattering looks soft. The lower row
# is a close-up.

# %%
opaque = sj.Scene(baselines.PhongSplats.of(body), lights, skin.opaque())
methods = {
    "elliptical points": (opaque, baselines.elliptical_points()),
    "EWA splatting": (opaque, baselines.ewa_splatting()),
    "Phong splatting": (opaque, baselines.phong_splatting()),
    "deferred splatting": (opaque, baselines.deferred_splatting()),
    "with scattering": (sj.Scene(body, lights, skin), sj.RenderSettings()),
}
frames = {}
for name, (scene, settings) in methods.items():
    plan = sj.make_plan(scene, (camera, near), settings)
    light = sj.illuminate(scene, plan, settings)
    frames[name] = [sj.render(scene, each, settings, plan, light=light) for each in (camera, near)]
rows = [[frame.beauty for frame in line] for line in zip(*frames.values(), strict=True)]
plot_pictures(rows, list(frames))

# %% [markdown]
# The numbers measure the roughness of the light by the mean difference between neighboring pixels
# inside the body.

# %%
roughness = {}
for name, (frame, _) in frames.items():
    inside = np.asarray(frame.coverage) > 0.99
    steps = np.abs(np.diff(np.asarray(frame.beauty).mean(axis=2), axis=1))
    roughness[name] = steps[inside[:, 1:] & inside[:, :-1]].mean()
    print(f"{name}: {roughness[name]:.4f}")

# %%
assert roughness["elliptical points"] > 1.3 * roughness["deferred splatting"]
assert roughness["deferred splatting"] > 1.05 * roughness["with scattering"]
