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
# Figure 6 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` describes it.

# %%
# %matplotlib inline

import jax.numpy as jnp
import numpy as np

import splatjax as sj
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
materials = {name: sj.load_material(name) for name in ("marble", "ketchup", "wholemilk")}

# %% [markdown]
# Skin takes its color from the albedo map of the body; the other materials have their own color.
# Each picture has its own exposure.

# %%
plain = body.without_maps()
frames = [sj.render(sj.Scene(body, lights, sj.load_material("skin").white()), camera)]
frames += [sj.render(sj.Scene(plain, lights, each), camera) for each in materials.values()]
pictures = [frame.beauty / jnp.quantile(frame.beauty, 0.995) for frame in frames]
plot_pictures([pictures], ["skin", *materials], white=1.0, inches=3.0)

# %% [markdown]
# The numbers are the ratio of red to blue of each material, in its profile and in the picture.

# %%
totals = [np.asarray(frame.diffuse).sum(axis=(0, 1)) for frame in frames[1:]]
shown = [total[0] / total[2] for total in totals]
reflected = [each.total_reflectance() for each in materials.values()]
expected = [float(total[0] / total[2]) for total in reflected]
print(*materials, "red over blue", np.round(shown, 2), "in the profile", np.round(expected, 2))

# %%
np.testing.assert_allclose(shown, expected, rtol=0.15)
assert shown[1] > 3 * shown[0]
