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
# # Melanin and blood of a face, from pictures
#
# The color of skin has two main causes: melanin in the epidermis and blood in the dermis. This
# notebook tabulates the Gaussians of skin as a function of both, and renders skin types from light
# to dark and a face with freckles and a blush. Then it recovers the maps of melanin and blood from
# three pictures of the face, with error bars for every splat.
#
# The face has the size of a figurine, so that few splats resolve the distance that light travels in
# skin.

# %%
# %matplotlib inline
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.plots import plot_pictures
from splatjax.splatting import DenseRasterizer

# Evaluate every splat at every pixel, for small pictures. Omit `settings` for large pictures.
settings = sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())
WAVELENGTHS = (620, 550, 460)  # nm, instead of red, green and blue
VARIANCES = [0.03, 0.25, 2.0, 14.0]


@jax.jit
def skin(melanin, blood, oxygenation=0.75):
    return sj.scattering.Skin(melanin, blood, oxygenation, wavelengths=WAVELENGTHS).profile()


# %% [markdown]
# ## A table of skins
#
# The base is the lightest skin, because its profile is the widest. Each node of the table is one
# fit of weights; splines interpolate between nodes.

# %%
nodes = {"melanin": np.geomspace(0.01, 0.4, 7), "blood": np.geomspace(0.002, 0.08, 5)}
held = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
with jax.enable_x64(True):
    lightest = skin(melanin=0.01, blood=0.002)
    base = sj.fitting.fit_weights(
        lightest, VARIANCES, weights=held, rule=sj.fitting.TransportModel.rule
    )
    base = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), base)
    between = {"melanin": 0.035, "blood": 0.013}
    exact = np.asarray(skin(**between).total_reflectance())
table = sj.fitting.weight_table(skin, nodes, base)
tabulated = np.asarray(table.reflectance(table.fractions(between)))[0]
print("reflectance between nodes:", tabulated.round(4), "of the model:", exact.round(4))

# %% [markdown]
# ## Skin types, and a blush
#
# In the upper row, melanin increases to the right. The lower row has three times as much blood,
# with more oxygen. Each skin is one fit; a second table could interpolate oxygenation too.

# %%
bust = sj.bust(2500).scaled(1 / 8).without_maps()
camera = sj.Camera.look_at((9.0, 1.0, 72.0), (0.0, -2.2, 0.0), fov=27.0, width=72, height=72)
window = sj.DirectionalLight((-0.9, -0.6, -0.8), np.full(3, 2.4), cast_shadows=False)
fill = sj.DirectionalLight((1.0, 0.1, -0.9), np.full(3, 0.5), cast_shadows=False)
material = sj.Material(base, eta=1.5, roughness=0.35)
rows = []
for blood, oxygenation in ((0.006, 0.7), (0.02, 0.9)):
    rows.append([])
    for melanin in (0.012, 0.035, 0.09, 0.2):
        with jax.enable_x64(True):
            other = skin(melanin=melanin, blood=blood, oxygenation=oxygenation)
            factors = np.asarray(sj.fitting.weight_factors(base, other), np.float32)
        body = replace(bust, weights=np.broadcast_to(factors, (bust.count, *factors.shape)))
        picture = sj.render(sj.Scene(body, (window, fill), material), camera, settings).beauty
        rows[-1].append(np.asarray(picture))
plot_pictures(
    rows, [f"melanin {m:g}" for m in (0.012, 0.035, 0.09, 0.2)], ["pale", "blushing"], white=0.8
)

# %% [markdown]
# ## A face with freckles and a blush
#
# The three pictures have three different lights and noise of 1%. The fit starts from uniform skin.
# The figurine has no albedo, because a picture only determines the product of an albedo and the
# reflectance of the skin.

# %%
SPLATS, SIZE, NOISE = 800, 36, 0.01
figurine = sj.bust(SPLATS).scaled(1 / 16).without_maps()
view = sj.Camera.look_at((3.0, 0.0, 35.0), (0.0, -1.0, 0.0), fov=28.0, width=SIZE, height=SIZE)
ways = (-1.0, -0.3, -0.7), (1.0, -0.3, -0.7), (0.1, -1.0, -0.7)
lamps = [sj.DirectionalLight(way, np.full(3, np.pi), cast_shadows=False) for way in ways]
centers, normals = np.asarray(figurine.centers), np.asarray(figurine.normals)
front = np.flatnonzero((normals[:, 2] > 0.5) & (np.abs(centers[:, 1]) < 4))
rng = np.random.default_rng(4)


def spots(around: np.ndarray, width: float) -> np.ndarray:
    apart = np.linalg.norm(centers[:, None] - around[None], axis=2)
    return 1 - np.prod(1 - np.exp(-0.5 * (apart / width) ** 2), axis=1)


cheeks = np.asarray([[-2.4, -1.8, 4.0], [2.4, -1.8, 4.0]])
true = {
    "melanin": 0.025 * 4 ** spots(centers[rng.choice(front, 14, replace=False)], 0.8),
    "blood": 0.008 * 3 ** spots(cheeks, 1.8),
}
matte = sj.Material(base, eta=1.5, specular=0.0)
face = replace(figurine, weights=table.factors(true))
observations = []
for lamp in lamps:
    picture = np.asarray(sj.render(sj.Scene(face, (lamp,), matte), view, settings).beauty)
    deviation = np.full(picture.shape, NOISE * np.sqrt(np.mean(picture**2)))
    noisy = picture + deviation * rng.normal(size=picture.shape)
    observations.append(sj.inverse.Observation(noisy, view, (lamp,), deviation=deviation))

# %% [markdown]
# ## Fit, and repeat with perturbed pictures
#
# Adam approaches the optimum, and L-BFGS refines the result. Fits of perturbed pictures give error
# bars that include noise and prior. The fits have not converged completely, so the error bars are
# somewhat too small; more steps remove this error.

# %%
start = {"melanin": 0.035, "blood": 0.012}
part = sj.inverse.ParameterMap(table, start, smoothness=0.3)
fit = partial(
    sj.inverse.fit_scene, splats=figurine, material=matte, parts=[part], settings=settings
)
adam = optax.adam(optax.cosine_decay_schedule(4.0, 20), b2=0.9)
lbfgs = optax.chain(optax.lbfgs(1.0, memory_size=50, linesearch=None), optax.clip(3.0))
near = fit(observations, optimizer=adam, steps=20)
fitted = fit(observations, optimizer=lbfgs, steps=80, start=near.restarted())
again = partial(fit, optimizer=lbfgs, steps=25)
draws = sj.inverse.randomized_fits(again, observations, fitted, 5)
print(f"loss {near.losses[0]:.3g}, {near.losses[-1]:.3g}, {fitted.losses[fitted.best]:.3g}")

lit = (normals[:, 2] > 0.4) & (centers[:, 1] > -6)
errors, bars = {}, {}
for name, values in true.items():
    found = np.asarray(fitted.maps[name])
    errors[name] = np.log(found / values)[lit]
    bars[name] = np.std(np.log([draw.maps[name] for draw in draws]), axis=0, ddof=1)
    within = np.mean(np.abs(errors[name]) < 2 * bars[name][lit])
    print(
        f"{name}: off by {np.median(np.abs(errors[name])):.1%} (median), bar "
        f"{np.median(bars[name][lit]):.1%}, {within:.0%} within two bars; at the start "
        f"{np.median(np.abs(np.log(start[name] / values[lit]))):.0%}"
    )

# %%
figure, axes = plt.subplots(2, 4, figsize=(11, 5.6), layout="constrained")
for row, (name, values) in zip(axes, true.items(), strict=True):
    shown = values, np.asarray(fitted.maps[name]), np.asarray(draws[0].maps[name]), bars[name]
    limits = values[lit].min(), values[lit].max()
    for ax, column, title in zip(row, shown, ("true", "found", "a draw", "bar"), strict=True):
        low, high = (0, 0.3) if title == "bar" else limits
        points = ax.scatter(
            *centers[lit, :2].T, c=column[lit], s=60, vmin=low, vmax=high, cmap="viridis"
        )
        ax.set(title=f"{name}, {title}", aspect="equal", xticks=[], yticks=[])
        figure.colorbar(points, ax=ax, shrink=0.7)
plt.show()

# %%
plot_pictures(
    [[np.asarray(seen.picture) for seen in observations], list(fitted.pictures)],
    ["light 1", "light 2", "light 3"],
    ["photographed", "fitted"],
    white=0.8,
)

# %% [markdown]
# Melanin darkens all colors, and blood mainly green, so three colors separate the two. Where little
# light arrives, the error bars are wide and the maps keep their initial values.

# %%
assert np.all(np.abs(tabulated / exact - 1) < 1e-3)
assert np.median(np.abs(errors["melanin"])) < 0.1
assert np.median(np.abs(errors["blood"])) < 0.2
