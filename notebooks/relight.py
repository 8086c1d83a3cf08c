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
# # New light on a rendered view
#
# A picture is linear in its light. This notebook renders a bust once under each of 25 spherical
# harmonics. The picture under any smooth environment is then a sum, which takes milliseconds. The
# notebook also solves the inverse problem: it recovers the environment from one photograph of a
# known body.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import splatjax as sj
from splatjax.scene import HarmonicLight, even_directions

splats, material = sj.bust(12_000), sj.load_material("skin").white()
camera = sj.Camera.look_at((60, -20, 620), (0, -40, 0), fov=30, width=128, height=128)

# %% [markdown]
# ## A rotating environment
#
# The coefficients of the light are zero here, because the basis does not depend on them. Light
# comes from 64 directions, whose shadow maps are rendered once.

# %%
scene = sj.Scene(splats, HarmonicLight(np.zeros((25, 3))), material)
plan = sj.make_plan(scene, camera)
kept = sj.transfer(scene, plan)
basis = sj.relighting_basis(scene, camera, plan=plan, light=kept)

pictures = [
    basis.beauty(HarmonicLight.of(sj.EnvironmentLight(sj.scene.studio(), rotation)))
    for rotation in (0, 60, 120, 180, 240, 300)
]
figure = Figure(figsize=(12, 2))
ax = figure.add_axes((0, 0, 1, 1), frameon=False, xticks=[], yticks=[])
ax.imshow(jnp.clip(jnp.concatenate(pictures, axis=1), 0, 1) ** (1 / 2.2))
figure  # noqa: B018

# %% [markdown]
# ## The environment of a photograph
#
# Two photographs are rendered with noise of 1%: one under a soft studio of nine harmonics, and one
# under the full studio, which has many more. The plan and shadow maps above are for harmonics; the
# full studio has its own.

# %%
whole = sj.EnvironmentLight(sj.scene.studio(), 60, directions=even_directions(64))
soft = HarmonicLight.of(whole, 2)


def rendered(scene, **parts):
    return np.asarray(sj.render(scene, camera, **parts).beauty)


clean = {
    "soft": rendered(sj.Scene(splats, soft, material), plan=plan, light=kept),
    "whole": rendered(sj.Scene(splats, whole, material)),
}
noise = 0.01 * np.sqrt(np.mean(clean["soft"] ** 2))
noisy = {
    name: picture + noise * np.random.default_rng(0).normal(size=picture.shape)
    for name, picture in clean.items()
}

# %% [markdown]
# The coefficients of each channel are fitted to all pixels by linear least squares. The residual
# gives the noise and the error bars. The soft studio has nine unknowns; the full studio has 25, of
# which the first nine are shown.


# %%
def recover(photograph, count):
    columns = np.moveaxis(np.asarray(basis.pictures[:count], float), -1, 0)
    columns, pixels = columns.reshape(3, count, -1), photograph.reshape(-1, 3).T[..., None]
    information = columns @ columns.mT
    coefficients = np.linalg.solve(information, columns @ pixels)
    left = np.sum((pixels - columns.mT @ coefficients) ** 2, axis=1) / (pixels.shape[1] - count)
    bars = np.sqrt(left * np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    return coefficients[:, :9, 0], bars[:, :9], np.sqrt(left)


found = {"soft": recover(noisy["soft"], 9), "whole": recover(noisy["whole"], 25)}
true = np.asarray(soft.coefficients).T
off = {
    name: np.linalg.norm(ours - true) / np.linalg.norm(true) for name, (ours, *_) in found.items()
}

# %%
figure = Figure(figsize=(12, 2.6), layout="constrained")
axes = figure.subplots(1, 4, width_ratios=(1, 2, 1, 2))
for (name, (ours, bars, left)), picture, plot in zip(
    found.items(), axes[::2], axes[1::2], strict=True
):
    picture.imshow(np.clip(noisy[name], 0, 1) ** (1 / 2.2))
    plot.errorbar(np.arange(27), (ours - true).ravel(), bars.ravel(), fmt=".")
    plot.set(title=f"{name} studio: found less true", xlabel="harmonics of red, green, blue")
    print(
        f"{name} studio: {100 * off[name]:.1f}% off, {np.std((ours - true) / bars):.1f} error bars;"
        f" {np.max(left) / noise:.2f} times the noise is left over"
    )
figure  # noqa: B018

# %% [markdown]
# For the soft studio, the true values are within the error bars. The full studio contains light
# that a sum of 25 harmonics cannot represent. Its residual exceeds the noise, which indicates that
# the error bars are too small, but the nine coefficients are still accurate to a few percent.

# %%
assert np.max(np.abs(found["soft"][0] - true) / found["soft"][1]) < 4
assert off["whole"] < 0.1
