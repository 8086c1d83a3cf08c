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
# # Bumps recovered from shading
#
# A ball of two centimeters has bumps and dents of half a millimeter and more. The fit starts from a
# smooth ball, and uses pictures of the true ball under three lights, with noise of 1%. Each splat
# may move along its normal, and the normals follow the displaced surface. Light that spreads below
# the surface fills the dark side of each bump, so shading contains less information. The notebook
# compares a material in which light hardly spreads with one in which light spreads over the width
# of the bumps.

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np
import optax

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.plots import plot_pictures
from splatjax.splatting import DenseRasterizer

SPLATS, SIZE, STEPS, NOISE, RADIUS = 900, 30, 24, 0.01, 10.0
# Evaluate every splat at every pixel, for small pictures. Omit `settings` for large pictures.
settings = sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())


# Evenly spread directions.
def spread(count: int) -> np.ndarray:
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack(
        [np.cos(turn) * np.sqrt(1 - z * z), np.sin(turn) * np.sqrt(1 - z * z), z], axis=1
    )


def ball() -> sj.Splats:
    ways, area = spread(SPLATS), 4 * np.pi * RADIUS**2 / SPLATS
    columns = RADIUS * ways, ways, np.full(SPLATS, 1.5 * np.sqrt(area)), np.full(SPLATS, area)
    return sj.Splats(*(jnp.asarray(each, jnp.float32) for each in columns))


# Bumps and dents, mm.
def heights(ways: np.ndarray) -> np.ndarray:
    away = RADIUS * np.arccos(np.clip(ways @ spread(40).T, -1, 1))
    return np.exp(-0.5 * (away / 1.4) ** 2) @ np.where(np.arange(40) % 3, 0.7, -0.5)


def degrees(a, b) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(np.asarray(a) * np.asarray(b), axis=-1), -1, 1)))


smooth = ball()
camera = sj.Camera.look_at(
    jnp.asarray([0.0, 0.0, 60.0]), jnp.zeros(3), fov=22.0, width=SIZE, height=SIZE
)
directions = [-1.0, -0.5, -0.5], [1.0, -0.4, -0.5], [0.0, 1.0, -0.5]
lamps = [
    sj.DirectionalLight(jnp.asarray(way), jnp.full(3, np.pi), cast_shadows=False)
    for way in directions
]
# Use the heights without blur.
as_given = sj.inverse.NormalOffsets(step=1.0, smoothness=1e-3, deviation=1.0)
bumpy = as_given.moved(
    sj.inverse.PicturedScene(smooth, camera, tuple(lamps)),
    jnp.asarray(heights(np.asarray(smooth.normals)), jnp.float32),
    as_given.prepared(smooth),
).splats
weights = jnp.asarray([[0.35, 0.35, 0.4], [0.3, 0.25, 0.2], [0.2, 0.15, 0.1]])


# `wider` scales the widths over which light spreads, 0.5, 1.2 and 2.8 mm.
def material(wider: float) -> sj.Material:
    return sj.Material(
        sj.SumOfGaussians(wider**2 * jnp.asarray([0.3, 1.5, 8.0]), weights), eta=1.5, specular=0.0
    )


# %% [markdown]
# ## Fit by gradients
#
# Offsets are blurred over 1 mm, about the spacing of the splats, so finer bumps are not recovered.
# Outlines are not used, because only pixels that the body fills count.


# %%
def taken(splats: sj.Splats, wider: float) -> list[np.ndarray]:
    return [
        np.asarray(sj.render(sj.Scene(splats, (lamp,), material(wider)), camera, settings).beauty)
        for lamp in lamps
    ]


part = sj.inverse.NormalOffsets(step=0.04, smoothness=1.0, deviation=0.4)
facing = np.asarray(smooth.normals)[:, 2] > 0.5
before = degrees(smooth.normals, bumpy.normals)[facing]
found, pictures, after = {}, {}, {}
for wider in (0.2, 1.0):
    rng, seen = np.random.default_rng(1), []
    pictures[wider] = taken(bumpy, wider)
    for picture, lamp in zip(pictures[wider], lamps, strict=True):
        deviation = np.full(picture.shape, NOISE * np.sqrt(np.mean(picture**2)))
        seen.append(
            sj.inverse.Observation(
                picture + deviation * rng.normal(size=picture.shape),
                camera,
                (lamp,),
                deviation=deviation,
            )
        )
    optimizer = optax.adam(optax.cosine_decay_schedule(2.0, STEPS), b2=0.9)
    found[wider] = sj.inverse.fit_scene(
        seen, smooth, material(wider), [part], optimizer, steps=STEPS, settings=settings
    )
    after[wider] = degrees(found[wider].splats.normals, bumpy.normals)[facing]
    print(
        f"light spreads {wider:g} x: normals off by {np.mean(before):.1f} degrees before, "
        f"{np.mean(after[wider]):.1f} after"
    )

# %%
rows = [[taken(body, wider)[0] for body in (smooth, bumpy, found[wider].splats)] for wider in found]
plot_pictures(rows, ["given", "true", "found"], [f"light spreads {wider:g} x" for wider in found])

# %%
assert np.mean(after[0.2]) < np.mean(after[1.0]) < 0.5 * np.mean(before)
