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
# # Checking and viewing gradients
#
# A picture is a differentiable function of optical coefficients, splats, lights and camera. The
# first part checks the derivatives of the diffusion pass against finite differences. The second
# part shows a derivative picture, the change of each pixel with a little more absorption.

# %%
# %matplotlib inline
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import splatjax as sj


# %%
# From coefficients (1/mm) to the profile to Gaussians. The fit is differentiated implicitly.
def gaussians_of(medium: sj.Medium) -> sj.SumOfGaussians:
    return sj.fit_gaussians(
        sj.Dipole(medium), 4, weights=sj.fitting.FixedTotalReflectance()
    ).gaussians


def scene_of(gaussians: sj.SumOfGaussians, count: int) -> sj.Scene:
    light = sj.DirectionalLight(jnp.asarray([-1.0, -0.25, -0.35]), jnp.full(3, np.pi))
    bare = eqx.tree_at(
        lambda splats: splats.albedo, sj.bust(count), None
    )  # without maps, the material determines the color
    return sj.Scene(bare, (light,), sj.Material(gaussians, eta=1.5, specular=0.0))


camera = sj.Camera.look_at(
    jnp.asarray([60.0, -10.0, 560.0]),
    jnp.asarray([0.0, -30.0, 0.0]),
    fov=30.0,
    width=128,
    height=128,
)

# %% [markdown]
# ## A check of the diffusion pass
#
# `sj.diffuse_irradiance` is pass 4 alone, which computes one layer per Gaussian from the light
# below the surface of every splat. In double precision, along a random direction of each input,
# reverse mode must agree with central differences. Visibility has no derivative, so the steps of
# the splats must be small enough that no splat becomes visible or hidden.

# %%
with jax.enable_x64(True):
    gaussians = sj.SumOfGaussians(
        jnp.asarray([40.0, 150.0]), jnp.asarray([[0.4, 0.3, 0.2], [0.3, 0.2, 0.1]])
    )
    small = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), scene_of(gaussians, 2000))
    lens = dataclasses.replace(camera, width=32, height=32)
    rng = np.random.default_rng(0)
    inputs = small, jnp.asarray(rng.uniform(size=(small.splats.count, 3)))
    pattern = jnp.asarray(rng.uniform(-0.5, 1, (2, 32, 32, 3)))
    plan = sj.make_plan(small, lens)

    @jax.jit
    @jax.value_and_grad
    def loss_and_gradient(inputs):
        scene, irradiance = inputs
        return jnp.mean(sj.diffuse_irradiance(scene, irradiance, lens, plan=plan) * pattern)

    _, gradient = loss_and_gradient(inputs)
    parts = {
        "variances": (lambda i: i[0].material.gaussians.variances, 1e-6),
        "weights": (lambda i: i[0].material.gaussians.weights, 1e-4),
        "centers": (lambda i: i[0].splats.centers, 1e-6),
        "areas": (lambda i: i[0].splats.areas, 1e-6),
        "irradiance": (lambda i: i[1], 1e-4),
    }
    errors = {}
    for name, (part, step) in parts.items():
        leaf = part(inputs)
        way = jnp.asarray(rng.normal(size=leaf.shape)) * jnp.mean(jnp.abs(leaf))
        ends = [eqx.tree_at(part, inputs, leaf + s * way) for s in (step, -step)]
        above, below = (float(loss_and_gradient(end)[0]) for end in ends)
        difference = (above - below) / (2 * step)
        errors[name] = abs(float(jnp.vdot(part(gradient), way)) / difference - 1)
        print(f"{name:10s} reverse mode differs from differences by {errors[name]:.0e}")

# %% [markdown]
# ## A derivative picture
#
# `sj.picture_jacobian` renders a picture and computes the derivative of every pixel with respect to
# every weight and variance. It takes about twice as long as a frame, for any number of pixels.
# `through` extends the derivative to the parameters of the Gaussians, here the coefficients of
# marble.

# %%
with jax.enable_x64(True):
    medium = sj.load_medium("marble")
    gaussians = gaussians_of(medium)
scene = scene_of(jax.tree.map(lambda leaf: leaf.astype(jnp.float32), gaussians), 20_000)
plan = sj.make_plan(scene, camera)
jacobian = sj.picture_jacobian(scene, camera, plan=plan)
with jax.enable_x64(True):
    by_coefficient = jacobian.through(gaussians_of, medium)


# %%
# The change of the picture if a coefficient increases by 1%, in all channels.
def change(name: str) -> np.ndarray:
    return np.asarray(
        getattr(by_coefficient, name) @ (0.01 * getattr(medium, name).astype(jnp.float32))
    )


picture = np.asarray(jacobian.frame.beauty)
figure = Figure(figsize=(11, 3.6), layout="constrained")
first, *others = figure.subplots(1, 3)
first.imshow(np.clip(picture, 0, 1) ** (1 / 2.2))
first.set_title("marble")
titles = {"sigma_a": "absorption", "sigma_s_prime": "scattering"}
for ax, (name, title) in zip(others, titles.items(), strict=True):
    red = picture[..., 0]
    share = np.where(red > 2e-3, 100 * change(name)[..., 0] / np.maximum(red, 2e-3), 0.0)
    scale = np.quantile(np.abs(share), 0.995)
    image = ax.imshow(share, cmap="RdBu_r", vmin=-scale, vmax=scale)
    ax.set_title(f"1% more {title}, red channel")
    figure.colorbar(image, ax=ax, shrink=0.7, label="% of the pixel")
figure  # noqa: B018

# %% [markdown]
# More absorption darkens all pixels. The relative loss is greatest where light has traveled far,
# beyond the edge of the shadow. With more scattering, light returns sooner, so lit parts become
# brighter and shadows darker.
#
# Finite differences need two fits and two frames for every coefficient:

# %%
pictures = []
for factor in (1.01, 0.99):
    with jax.enable_x64(True):
        moved = gaussians_of(eqx.tree_at(lambda m: m.sigma_a, medium, medium.sigma_a * factor))
    moved = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), moved)
    end = eqx.tree_at(lambda s: s.material.gaussians, scene, moved)
    pictures.append(np.asarray(sj.render(end, camera, plan=plan).beauty))
difference = (pictures[0] - pictures[1]) / 2
error = np.linalg.norm(change("sigma_a") - difference) / np.linalg.norm(difference)
print(f"derivative picture minus finite differences: {error:.1e} of its norm")

# %%
assert max(errors.values()) < 1e-5
assert error < 1e-2
assert np.all(change("sigma_a") < 1e-6)
assert change("sigma_s_prime")[picture > 0.2].mean() > 0
