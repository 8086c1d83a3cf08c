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
# # Figure 5: wider splats, fewer splats
#
# Figure 5 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` explains the law of these
# errors.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines
from splatjax.diffusion import PlainMean
from splatjax.plots import plot_pictures

# %% [markdown]
# One light casts shadows; a second, weak light does not. The layers are two, four and eight times
# as wide as the spacing of the splats.

# %%
body = sj.bust(20_000)
low, high = jnp.min(body.centers, axis=0), jnp.max(body.centers, axis=0)
eye = (low + high) / 2 + (high[1] - low[1]) * jnp.asarray([0.9, 0.1, 1.9])
camera = sj.Camera.look_at(eye, (low + high) / 2, fov=28.0, width=128, height=128)
lights = (
    sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi)),
    sj.DirectionalLight(jnp.asarray([-0.7, -0.2, -0.7]), jnp.full(3, 0.3), cast_shadows=False),
)
spacing = jnp.sqrt(jnp.mean(body.areas))
amplified, keep = jnp.asarray([2.0, 4.0, 8.0]), (1, 4, 16)
gaussians = sj.SumOfGaussians((amplified * spacing) ** 2, jnp.full((3, 3), 1 / 3))
scene = sj.Scene(body, lights, sj.Material(gaussians, specular=0.0))

# %% [markdown]
# The radius increases to the right, and the number of splats decreases downwards. The quality is
# constant along a diagonal, because a radius twice as large allows a quarter of the splats. The
# numbers are root mean square errors, relative to the root mean square of the layer, and the
# predictions of the law with one fitted factor.

# %%
settings = [
    sj.RenderSettings(diffuser=baselines.ThinnedDiffuser(number), kernel=PlainMean())
    for number in keep
]
rows = [np.asarray(sj.render(scene, camera, each).layers) for each in settings]
plot_pictures(
    rows, [f"radius x {float(a):g}" for a in amplified], ["all splats", "1 of 4", "1 of 16"]
)

# %%
norms = np.linalg.norm(rows[0].reshape(3, -1), axis=1)
measured = [np.linalg.norm((row - rows[0]).reshape(3, -1), axis=1) / norms for row in rows[1:]]
plan = sj.make_plan(scene, camera, settings[0])
source = sj.compute_irradiance(scene, plan, settings[0]).source.T
contrast = jnp.stack([baselines.layer_contrast(body, source, v) for v in gaussians.variances])
ratios = 1 / jnp.asarray(keep[1:])
law = np.asarray(
    baselines.thinning_error(amplified[None], jnp.ones(()), ratios[:, None], contrast[None])
)
print("measured", np.round(measured, 3), "by the law", np.round(law, 3), sep="\n")

# %%
# The law holds for the mean over many selections of splats; the worst layer is off by up to 1.63.
assert np.max(np.abs(np.log(measured / law))) < np.log(1.63)
