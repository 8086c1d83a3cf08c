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
# # Which profile for which material
#
# All models below compute a profile from the same coefficients. They differ near the source, where
# diffusion is a poor approximation, and agree at large distances. The dots are the reference,
# `sj.transport.monte_carlo`, with standard errors. Radii are in mean free paths, $r \sigma_t'$.
# [Which profile when](../docs/which_profile.md) has the numbers for many media.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import splatjax as sj

# %%
media = {
    "marble, green": (0.0041, 2.62, 1.5),
    "skin, red": (0.032, 0.74, 1.3),
    "skin, blue": (0.48, 1.01, 1.3),
}
models = {
    "Dipole": sj.Dipole,
    "BetterDipole": sj.scattering.BetterDipole,
    "PhotonBeam": sj.scattering.PhotonBeam,
}


def burley(medium: sj.Medium) -> sj.scattering.Burley:
    """Make normalized diffusion with the albedo of the photon beam and the mean free path."""
    albedo = sj.scattering.PhotonBeam(medium).total_reflectance()
    return sj.scattering.Burley(albedo, 1 / (medium.sigma_a + medium.sigma_s_prime))


# %%
truth = {}
for name, numbers in media.items():
    medium = sj.Medium(*(jnp.asarray([x], jnp.float32) for x in numbers))
    edges = jnp.geomspace(0.08, 20.0, 41, dtype=jnp.float32) / medium.sigma_t_prime
    truth[name] = sj.transport.monte_carlo(
        [sj.Layer(medium, jnp.asarray(jnp.inf))], 100_000, jax.random.key(1), edges=edges
    )

# %%
curves, totals = {}, {}
with jax.enable_x64(True):
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    for axes, (name, numbers) in zip(figure.subplots(1, 3), media.items(), strict=True):
        medium = sj.Medium(*(jnp.asarray([x]) for x in numbers))
        free_path = 1 / float((medium.sigma_a + medium.sigma_s_prime)[0])
        r = free_path * jnp.geomspace(0.1, 16, 120)
        for label, model in {**models, "Burley": burley}.items():
            made = model(medium)
            curves[name, label] = np.asarray(made(r))[:, 0]
            totals[name, label] = float(made.total_reflectance()[0])
            axes.loglog(r / free_path, np.asarray(r) * curves[name, label] * free_path, label=label)
        rings, r = truth[name].reflected, np.asarray(truth[name].radii)
        value, deviation = (
            np.asarray(each)[:, 0] * r * free_path for each in (rings.value, rings.deviation)
        )
        known = deviation < 0.2 * value
        dots = r[known] / free_path, value[known], deviation[known]
        axes.errorbar(*dots, fmt="k.", ms=3, lw=0.8, label="Monte Carlo")
        axes.set(title=name, xlabel="r (mean free paths)", ylabel="r R(r) (per mean free path)")
    axes.legend(frameon=False)
figure  # noqa: B018

# %% [markdown]
# - **Dipole** (Jensen 2001): the model of most published fits and coefficients. It has too much
#   light between one and two mean free paths, and too little in the tail for strong absorption. Use
#   it to compare with the literature.
# - **BetterDipole** (d'Eon 2012): the same cost, the best totals, and errors of about ten percent
#   beyond one mean free path for weak absorption.
# - **PhotonBeam** (Habel 2013): includes single scattering, which diverges like $1/r$ at the
#   origin. Beyond one mean free path its error for marble is a few percent. If in doubt, use it
#   with a cut.
# - **Burley** (Christensen 2015): a curve fitted to Monte Carlo, with a color and a length as
#   parameters, as in many film renderers. It does not include the index of refraction, so for
#   marble, whose surface reflects much of the light back inside, it decays too early.
# - **Multipole** and **LayeredMultipole** (Donner 2005): slabs and layers at least four mean free
#   paths thick, for skin, leaves and paper.
#
# The total reflectances differ too.

# %%
for name in media:
    found = truth[name].total_reflectance
    true = f"truth {float(found.value[0]):.3f} +- {float(found.deviation[0]):.3f}"
    print(
        f"{name:14s}",
        true,
        " ".join(f"{label} {totals[name, label]:.3f}" for label in (*models, "Burley")),
    )

# %% [markdown]
# For profiles with a $1/r$ core, the integral of $r R^2$ diverges at the origin. Their Gaussians
# are fitted beyond a cut, given in length scales of the profile; the narrowest Gaussians represent
# the part inside the cut.

# %%
with jax.enable_x64(True):
    beam = sj.scattering.PhotonBeam(sj.Medium(*(jnp.asarray([x]) for x in media["marble, green"])))
    fitted = sj.fit_gaussians(beam, 4, rule=sj.scattering.L2_QUADRATURE.beyond(1.0))
    error = float(fitted.error[0])
print("E beyond one mean free path", round(error, 4))

# %% [markdown]
# Gaussians can also be fitted to the reference itself, weighted by its errors, with the sum of the
# weights fixed to the true total.

# %%
photons = truth["marble, green"]
with jax.enable_x64(True):
    profile = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), photons.profile())
    rule, held = (
        sj.scattering.InverseVariance(sj.scattering.L2_QUADRATURE.beyond(0.2)),
        sj.fitting.FixedTotalReflectance(),
    )
    true_fit = sj.fit_gaussians(profile, 5, weights=held, rule=rule, throw=False)
    energy = float(true_fit.energy_error[0])
print("weights", np.asarray(true_fit.gaussians.weights)[:, 0].round(4), "energy error", energy)

# %%
for name in media:
    assert curves[name, "PhotonBeam"][0] > curves[name, "BetterDipole"][0]
marble = [curves["marble, green", label][-1] for label in models]
assert np.ptp(marble) < 0.15 * np.mean(marble)
assert error < 0.02
for name, found in truth.items():
    beam = totals[name, "PhotonBeam"] / float(found.total_reflectance.value[0])
    assert 1.0 < beam < 1.12, (name, beam)
assert abs(energy) < 1e-9
