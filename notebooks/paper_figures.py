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
# # The paper's figures, small
#
# Figures 1 and 3 to 8 of "Subsurface scattering using splat-based diffusion in point-based rendering", from the built-in bust.
# `splatjax figure 7 --output figure_7.png` and so on make them larger, and from scanned heads; `docs/figures.md` says what to
# see.

# %%
# %matplotlib inline
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import plots, rivals
from splatjax.geometry import sample_mesh

# %% [markdown]
# A bust of a third of life size, so that few splats resolve what light does in skin, under one light with shadows.

# %%
eye, middle = jnp.asarray([400.0, -30.0, 820.0]), jnp.asarray([0.0, -60.0, 0.0])
light = sj.DirectionalLight(jnp.asarray([0.5, -0.4, -0.75]), jnp.full(3, jnp.pi))
camera = sj.Camera.look_at(eye, middle, fov=22.0, width=192, height=192)
bust = plots.Subject("bust", sj.bust(20_000), (light,), camera).scaled(0.3)
skin, marble = sj.load_material("skin"), sj.load_material("marble")

# %% [markdown]
# Figure 1: splats; the surface they make; light below it.

# %%
plots.figure_1(bust, skin, discs=3000)

# %% [markdown]
# Figure 3: what a splat of each layer looks like, and the profile they add up to.

# %%
plots.figure_3(skin.gaussians, title="skin")

# %% [markdown]
# Figure 4: the layers of a picture. Blue and green stay where they enter, red travels.

# %%
plots.figure_4(bust, skin)

# %% [markdown]
# Figure 5: the wider the splats, the fewer of them do. Errors follow a law with one fitted factor.

# %%
few = plots.Subject("bust", sj.bust(8000), (light,), sj.Camera.look_at(eye, middle, fov=22.0, width=64, height=64))
plots.figure_5(few, amplified=(2.0, 4.0, 8.0), keep=(1, 4, 16))

# %% [markdown]
# Figure 6: other materials.

# %%
plots.figure_6([bust], {"skin": skin, "marble": marble})

# %% [markdown]
# Figure 7: elliptical points are flat, splats that are blended are smooth, scattering is soft.

# %%
plots.figure_7(bust, skin)


# %% [markdown]
# Figure 8: left of the line triangles with texture-space diffusion, right of it splats. The bust's chart is longitude and latitude.

# %%
mesh, textures = rivals.bust_with_textures(256)
splats = sample_mesh(mesh, 20_000, textures=textures)
head = plots.Subject("bust", splats, (light,), camera).scaled(0.3)
triangles = rivals.TexturedMesh.of(mesh, textures)
triangles = replace(triangles, vertices=0.3 * triangles.vertices)
plots.figure_8(head, triangles, skin)

# %% [markdown]
# In numbers: how rough the light is, as the mean step from pixel to pixel inside the bust.


# %%
def roughness(material, settings=None):
    (frame,) = bust.drawn(material, settings)
    inside = np.asarray(frame.coverage) > 0.99
    luminance = np.asarray(frame.beauty).mean(axis=2)
    steps, both = np.abs(np.diff(luminance, axis=1)), inside[:, 1:] & inside[:, :-1]
    return float(steps[both].mean())


flat = roughness(skin.opaque(), rivals.elliptical_points())
blended = roughness(skin.opaque(), rivals.deferred_splatting())
soft = roughness(skin, None)
print(f"elliptical points {flat:.4f}, deferred splatting {blended:.4f}, with scattering {soft:.4f}")
narrow, wide, error, contrast = (jnp.asarray(value) for value in (4.0, 8.0, 0.02, 0.5))
fewer = [float(rivals.splats_that_suffice(width, jnp.asarray(1.0), error, contrast)) for width in (narrow, wide)]

# %%
assert flat > 1.3 * blended > 1.3 * soft
np.testing.assert_allclose(fewer[0] / fewer[1], 4, rtol=1e-5)
