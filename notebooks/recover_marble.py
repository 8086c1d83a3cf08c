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
# # Marble from one photograph
#
# A lamp lights a marble figurine, three centimeters tall, from the side. Its shape, the positions
# of camera and lamp, and the strength of the lamp are known. This notebook recovers the absorption
# and the scattering of the stone, with error bars, from one photograph.
#
# The photograph is rendered from the coefficients that Jensen et al. measured in 2001, so the true
# values are known. Noise of 1% is added.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.plots import plot_recovery
from splatjax.splatting import DenseRasterizer, ShadowSettings

SIZE, COUNT, NOISE = 40, 4, 0.01
DIPOLE = sj.fitting.DiffusionModel()
HELD = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
# Evaluate every splat at every pixel, with coarse shadows, for small pictures. Omit `settings` for
# large pictures.
shadows = ShadowSettings(resolution=48, bias=0.35, softness=0.7)
settings = sj.RenderSettings(
    shadows=shadows, rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()
)


# The bust, eight times smaller and without albedo, so that the coefficients determine the color.
def figurine(count: int) -> sj.Splats:
    bust = sj.bust(count)
    return sj.Splats(bust.centers / 8, bust.normals, bust.radii / 8, bust.areas / 64)


splats = figurine(1200)
camera = sj.Camera.look_at(
    jnp.asarray([8.0, 0.0, 70.0]), jnp.asarray([0.0, -3.5, 0.0]), fov=32.0, width=SIZE, height=SIZE
)
lamp = sj.DirectionalLight(jnp.asarray([-1.0, -0.3, -0.4]), jnp.full(3, np.pi))

# %%
with jax.enable_x64(True):
    marble = sj.load_medium("marble")
    gaussians = sj.fit_gaussians(DIPOLE.profile(marble), COUNT, weights=HELD).gaussians
    material = sj.Material(gaussians, eta=1.5, specular=0.0)
    rendered = np.asarray(sj.render(sj.Scene(splats, (lamp,), material), camera, settings).beauty)
    deviation = NOISE * np.sqrt(np.mean(rendered**2))
    photograph = rendered + deviation * np.random.default_rng(0).normal(size=rendered.shape)

# %% [markdown]
# ## The coefficients
#
# The search starts from skin, whose absorption is some tens of times larger. It fits the logarithms
# of both coefficients of red, green and blue to all pixels at once by least squares. The part of a
# picture that does not depend on the weights of its layers is rendered once, so the steps do not
# evaluate splats.

# %%
with jax.enable_x64(True):
    skin = sj.load_medium("skin1")
    start = sj.Medium(skin.sigma_a, skin.sigma_s_prime, marble.eta)
    taken = sj.inverse.Observation(
        photograph, camera, (lamp,), deviation=np.full(photograph.shape, deviation)
    )
    found = sj.inverse.recover([taken], splats, start, count=COUNT, settings=settings, model=DIPOLE)
print(found.summary())
print(f"{found.rounds} rounds, {found.steps} steps; chi-squared {float(found.chi_squared):.3f}")

# %%
figure = plot_recovery(found, title="marble, recovered")
figure  # noqa: B018

# %% [markdown]
# The residual is noise. The next cell prints the true values, and the errors in units of the error
# bars:

# %%
pulls = []
for name, bars in zip(("sigma_a", "sigma_s_prime"), found.relative_errors(), strict=True):
    true, ours = np.asarray(getattr(marble, name)), np.asarray(getattr(found.medium, name))
    pulls.append(np.log(ours / true) / bars)
    print(
        f"{name:14s} measured {true.round(4)}  recovered {ours.round(4)}  error bars off "
        f"{pulls[-1].round(1)}"
    )

# %% [markdown]
# ## Which picture to take next
#
# A picture determines the amount of returning light better than the distance that it travels, so
# one combination of the coefficients is known much better than the other. Each candidate picture,
# rendered with the recovered material, would add information; the inverse of the total information
# is the predicted covariance.

# %%
best, worst = found.combinations()[0]
print(
    f"red: {best} is known to {100 * best.deviation:.2g}%, {worst} to {100 * worst.deviation:.2g}%"
)
with jax.enable_x64(True):
    predictions = sj.inverse.next_pictures(
        found,
        splats,
        sj.inverse.default_candidates(splats, camera),
        settings=settings,
    )
for prediction in predictions:
    print(prediction)

# %%
now = max(worst.deviation for _, worst in found.combinations())
assert np.max(np.abs(pulls)) < 4
assert abs(float(found.chi_squared) - 1) < 0.1
assert predictions[0].worst.deviation < now
