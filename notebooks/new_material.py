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
# # A new material from coefficients, or from layers
#
# A material is defined by the absorption coefficient $\sigma_a$ and the reduced scattering
# coefficient $\sigma_s'$ of each channel, in 1/mm, and the index of refraction. This notebook fits
# a jade-like stone, and the same stone under a thin red glaze.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.plots import plot_error_by_count, plot_fit

# %%
weights = sj.fitting.FixedTotalReflectance()
with jax.enable_x64(True):
    stone = sj.Medium(
        sigma_a=jnp.asarray([0.020, 0.006, 0.015]),
        sigma_s_prime=jnp.asarray([1.1, 1.3, 1.5]),
        eta=jnp.full(3, 1.6),
    )
    profile = sj.Dipole(stone)
    by_count = sj.fitting.error_by_count(profile, 6, weights=weights)
    figure = plot_error_by_count(by_count, title="what each Gaussian gains")
figure  # noqa: B018

# %% [markdown]
# Each additional Gaussian divides the error by two to three and costs one more layer. The next cell
# selects the least number that reaches an error of 0.02 in every channel.
# (`fit_gaussians(profile, LeastCount(0.02))` does this in one call.) The sum of the weights is
# fixed to the total reflectance, which conserves the energy of the picture. (If the channels differ
# more, some weights become slightly negative; `NonNegativeWeights(FixedTotalReflectance())`
# prevents this, as for the materials of the library.)

# %%
with jax.enable_x64(True):
    count = by_count.least(0.02)
    fitted = sj.fit_gaussians(profile, count, weights=weights, start=by_count.start(count))
    figure = plot_fit(profile, fitted.gaussians, title=f"stone, {count} Gaussians")
    variances, covariance = np.asarray(fitted.gaussians.variances), np.asarray(fitted.covariance)
figure  # noqa: B018

# %% [markdown]
# `covariance` describes how well the fit determines the parameters: the variances, then the weights
# of red, green and blue. Within its ellipsoid the error of Eq. 3 at most doubles, so a relative
# deviation above 1 would mean that a Gaussian can be omitted.

# %%
print("variances (mm²)", variances.round(4))
print("  known to     ", (np.sqrt(np.diag(covariance))[:count] / variances).round(3))

# %% [markdown]
# A glaze of half a millimeter changes the core of the profile but hardly its tail, because light
# that travels far travels below the glaze. A scattering layer must be thicker than a mean free
# path, here $1 / (4 + 0.3)$ mm; thinner layers raise an error.

# %%
with jax.enable_x64(True):
    glaze = sj.Medium(jnp.asarray([0.02, 0.3, 0.3]), jnp.full(3, 4.0), jnp.full(3, 1.5))
    glazed = sj.LayeredMultipole(
        [sj.Layer(glaze, jnp.asarray(0.5)), sj.Layer(stone, jnp.asarray(jnp.inf))]
    )
    fitted_glaze = sj.fit_gaussians(glazed, 4)
    figure = plot_fit(glazed, fitted_glaze.gaussians, title="stone under a red glaze")
figure  # noqa: B018

# %% [markdown]
# A material consists of these Gaussians and a surface. `save_material` writes it with layers, unit
# and source to a TOML file, which `splatjax render --material glazed.toml` and `load_material`
# read.

# %%
with jax.enable_x64(True):
    material = sj.Material(fitted_glaze.gaussians, eta=1.5, specular=0.25, roughness=0.15)
    sj.save_material(material, "glazed.toml", profile=glazed, source={"provenance": "made up"})
    again = sj.load_material("glazed.toml")
    totals = [np.asarray(each.total_reflectance()) for each in (profile, glazed)]
    same = bool(jnp.all(again.gaussians.variances == material.gaussians.variances))
print("total reflectance, stone ", totals[0].round(3))
print("                  glazed ", totals[1].round(3))

# %%
assert jnp.max(fitted.error) < 0.0201
assert np.max(np.asarray(by_count.error)[count - 2]) > 0.02
assert np.max(np.abs(np.asarray(fitted.energy_error))) < 1e-12
assert jnp.max(fitted_glaze.error) < 0.03
assert same
assert np.all(totals[1][1:] < totals[0][1:])
