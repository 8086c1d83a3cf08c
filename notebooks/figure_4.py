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
# Figure 4 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` describes it.

# %%
# %matplotlib inline
import itertools

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.plots import plot_pictures

# %% [markdown]
# The bust is scaled to 0.15 of its size, so that few splats resolve the diffusion of light in skin.
# One light casts shadows; a second, weak light does not.

# %%
body = sj.bust(40_000).scaled(0.15)
low, high = jnp.min(body.centers, axis=0), jnp.max(body.centers, axis=0)
eye = (low + high) / 2 + (high[1] - low[1]) * jnp.asarray([0.9, 0.1, 1.9])
camera = sj.Camera.look_at(eye, (low + high) / 2, fov=28.0, width=256, height=256)
lights = (
    sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi)),
    sj.DirectionalLight(jnp.asarray([-0.7, -0.2, -0.7]), jnp.full(3, 0.3), cast_shadows=False),
)
skin = sj.load_material("skin").white()

# %% [markdown]
# The upper row shows the layers, the narrowest first. The lower row shows the contribution of each
# layer to the picture, with its weights for red, green and blue. Blue and green light leaves near
# its point of entry; red light travels farther. The layers are plain means as in the paper. The
# default kernel would make curved parts of the wide layers brighter (`docs/bodies.md`).

# %%
settings = sj.RenderSettings(kernel=sj.diffusion.PlainMean())
frame = sj.render(sj.Scene(body, lights, skin), camera, settings)
layers, weights = np.asarray(frame.layers), np.asarray(frame.weights)
titles = [f"{float(variance) ** 0.5:.2g} mm" for variance in skin.gaussians.variances]
plot_pictures([layers, weights[:, None, None] * layers], titles, ["layer", "what it adds"])

# %% [markdown]
# The numbers measure the roughness of each layer by the mean difference between neighboring pixels
# inside the body.

# %%
inside = np.asarray(frame.coverage) > 0.99
steps = np.abs(np.diff(layers.mean(axis=3), axis=2))[:, inside[:, 1:] & inside[:, :-1]].mean(axis=1)
print("steps of the layers:", np.round(steps, 4))

# %%
assert all(narrow >= wide for narrow, wide in itertools.pairwise(steps))
assert steps[0] > 1.3 * steps[-1]
