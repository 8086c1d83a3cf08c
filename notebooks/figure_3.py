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
# # Figure 3: a Gaussian on each splat, and their sum, the profile
#
# Figure 3 of "Subsurface scattering using splat-based diffusion in point-based rendering".
# `make figures` writes the picture; `docs/figures.md` describes it.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

import splatjax as sj

# %% [markdown]
# The upper row shows the Gaussian of each layer on a splat with the weights of red, green and blue,
# all at the same scale and over five decades of brightness. The lower row shows the profile of each
# channel, and the layers that sum to it.

# %%
skin = sj.load_material("skin").gaussians
reach = 2.5 * float(jnp.sqrt(skin.variances.max()))
axis, radii = jnp.linspace(-reach, reach, 181), jnp.linspace(0, reach, 400)
layers = [sj.SumOfGaussians(skin.variances[k : k + 1], skin.weights[k : k + 1]) for k in range(6)]
shades = LogNorm(*(float(layers[0](jnp.zeros(1)).mean()) * np.asarray([1e-5, 1])))

figure = Figure(figsize=(10.6, 6.2), dpi=150, layout="constrained")
above, below = figure.subfigures(2, 1, height_ratios=(1, 1.9))  # ty: ignore[not-iterable]
for axes, layer in zip(above.subplots(1, 6), layers, strict=True):
    spread = layer(jnp.hypot(axis[:, None], axis)).mean(axis=2)
    axes.imshow(np.maximum(spread, 1e-30), cmap="magma", norm=shades)
    axes.set(title=f"{float(jnp.sqrt(layer.variances[0])):.2g} mm", xticks=[], yticks=[])
    axes.set_xlabel("  ".join(f"{float(weight):.3f}" for weight in layer.weights[0]))
axes = below.subplots()
grays = ["0.45", "0.55", "0.65", "0.75", "0.85", "0.9"]
axes.stackplot(radii, [layer(radii).mean(axis=1) for layer in layers], colors=grays)
for channel, color in enumerate(("red", "green", "blue")):
    axes.plot(radii, skin(radii)[:, channel], color=color)
axes.set(xlabel="r (mm)", ylabel="R(r) (1/mm²)", yscale="log", xlim=(0, reach), ylim=(1e-5, 30))
figure  # noqa: B018

# %% [markdown]
# The numbers are the root mean square distances that light travels in each channel. Red light
# travels farthest.

# %%
totals = skin.total_reflectance()
distance = np.sqrt(2 * np.asarray(skin.variances @ skin.weights / totals))
print("red, green and blue go", np.round(distance, 2), "mm")

# %%
assert distance[0] > 2 * distance[1] > 2 * distance[2]
