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
# # Figure 1: splats, their surface, and light below it
#
# Figure 1 of "Subsurface scattering using splat-based diffusion in point-based rendering", with the
# built-in bust. `make figures` writes the picture; `docs/figures.md` describes it.

# %%
# %matplotlib inline
from dataclasses import replace

import jax
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
camera = sj.Camera.look_at(eye, (low + high) / 2, fov=28.0, width=384, height=384)
lights = (
    sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi)),
    sj.DirectionalLight(jnp.asarray([-0.7, -0.2, -0.7]), jnp.full(3, 0.3), cast_shadows=False),
)
skin = sj.load_material("skin").white()

# %% [markdown]
# The left picture shows some of the splats as discs with gaps between them. The middle shows the
# surface of all splats without scattering, so that light leaves the skin where it enters. The right
# shows the same surface with scattering.

# %%
step = body.count // 3000
few = jax.tree.map(lambda rows: rows[::step], body)
discs = replace(few, radii=0.5 * (step * few.areas) ** 0.5, areas=step * few.areas)
opaque = sj.Scene(body, lights, skin.opaque())
left = sj.render(replace(opaque, splats=discs), camera, baselines.elliptical_points())
middle = sj.render(opaque, camera, baselines.deferred_splatting())
right = sj.render(replace(opaque, material=skin), camera)
plot_pictures(
    [[frame.beauty for frame in (left, middle, right)]],
    ["surface splats", "light leaves where it enters", "light scatters below the surface"],
    inches=3.6,
)

# %% [markdown]
# The numbers compare the light that leaves the skin in the shadow of the first light with and
# without scattering. Red light travels farthest into the shadow.

# %%
shadow = (np.asarray(middle.coverage) > 0.99) & (np.asarray(middle.shadow)[0] < 1e-3)
plain, scattered = (np.asarray(frame.diffuse)[shadow].mean(axis=0) for frame in (middle, right))
gain = scattered / plain - 1
print("in the shadow, red, green and blue are brighter by", np.round(gain, 3))

# %%
assert gain[0] > 0.03
assert gain[0] > 3 * gain[2]
