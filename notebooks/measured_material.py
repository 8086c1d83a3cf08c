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
# # A material from a measurement
#
# A measured profile $R(r)$ is a table of radii and values. A linear photograph of a laser dot from
# straight above also gives a profile: its values are means over rings around the center of the dot,
# and the variation within the rings gives the errors.

# %%
# %matplotlib inline
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import splatjax as sj
from splatjax.plots import plot_fit

# %% [markdown]
# This is a synthetic photograph of a material like potato, with camera noise. The beam has a
# variance of 0.25 mm² along each axis. The photograph shows the profile blurred by the beam, so
# their variances add.

# %%
with jax.enable_x64(True):
    potato = sj.Medium(jnp.asarray([0.009]), jnp.asarray([0.70]), jnp.asarray([1.3]))
    beam_variance, power, mm_per_pixel = 0.25, 5.0, 0.1
    seen = sj.fit_gaussians(sj.Dipole(potato), 3).gaussians.blurred(beam_variance)
    y, x = (np.mgrid[:200, :200] - 99.5) * mm_per_pixel
    radiance = power / np.pi * np.asarray(seen(jnp.hypot(x, y)))
noise = np.random.default_rng(5).normal(size=radiance.shape)
photograph = radiance + 0.01 * np.sqrt(radiance.max() * (radiance + 0.1 * radiance.max())) * noise

figure = Figure(figsize=(4, 4), layout="constrained")
axes = figure.add_subplot(xlabel="mm", ylabel="mm", title="logarithm of radiance")
axes.imshow(np.log10(np.maximum(photograph[..., 0], 1e-4)), cmap="magma", extent=(-10, 10, -10, 10))
figure  # noqa: B018

# %% [markdown]
# `fit_medium` fits the absorption and scattering. It computes Gaussians from coefficients and the
# blurred profile from the Gaussians, and minimizes the residual by its derivatives. The error bars
# are computed from the variation of the pixels.

# %%
with jax.enable_x64(True):
    dot = sj.scattering.measure_laser_dot(photograph, mm_per_pixel, power=power)
    guess = sj.Medium(jnp.asarray([0.05]), jnp.asarray([2.0]), potato.eta)
    found = sj.fitting.fit_medium(dot.profile, guess, beam_variance=beam_variance, count=3)
    bars = np.sqrt(np.diagonal(np.asarray(found.covariance)[0]))
    values = np.asarray([found.medium.sigma_a[0], found.medium.sigma_s_prime[0]])
    chi_squared = float(found.chi_squared[0])
for name, value, bar in zip(("sigma_a ", "sigma_s'"), values, bars, strict=True):
    print(f"{name} {value:.4f} 1/mm, known to {100 * bar:.1f}%")
print(f"chi squared per degree of freedom {chi_squared:.2f}")

# %% [markdown]
# Without a model, Gaussians can be fitted to the table itself, over its own radii only.
# `splatjax fit potato.csv --output potato.toml` does this for a CSV file with a column of radii and
# a column per channel.

# %%
with jax.enable_x64(True):
    rows = np.column_stack([dot.profile.radii, dot.profile.values])
    np.savetxt("potato.csv", rows, delimiter=",", header="radius (mm), R (1/mm^2)")
    table = sj.io.read_profile("potato.csv")
    fitted = sj.fit_gaussians(table, 3, weights=sj.fitting.NonNegativeWeights())
    error = float(fitted.error[0])
    figure = plot_fit(table, fitted.gaussians, title="potato, measured, three Gaussians")
figure  # noqa: B018

# %% [markdown]
# For other renderers, the material is exported as JSON, with the formula and the source of each
# number.

# %%
with jax.enable_x64(True):
    sj.io.save_exports(sj.Material(fitted.gaussians, eta=1.3), "potato.json")
sheet = json.loads(Path("potato.json").read_text())
for name in ("burley", "unity", "blender"):
    print(name, sheet[name])

# %%
assert np.all(np.abs(np.log(values / [0.009, 0.70])) < 3 * bars)
assert np.all(bars < 0.1)
assert 0.5 < chi_squared < 1.6
assert error < 0.05
assert sheet["burley"]["d"][0] > 0
