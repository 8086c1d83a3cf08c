"""Make the pictures of docs/gallery.md: `python tools/make_gallery.py [name ...] [--head
head.ply]`, all of them by default.

They land in out/gallery. Those of skin show a scanned head where one is given (docs/gallery.md
describes how it is sampled), and the built-in bust otherwise.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from PIL import Image
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

import splatjax as sj
from splatjax.geometry import Mesh, sample_mesh, vertex_normals
from splatjax.io import linear_to_srgb

FOLDER = Path(__file__).resolve().parents[1] / "out" / "gallery"
HELD = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())


def dim(strength) -> sj.EnvironmentLight:
    """Return a studio of some strength."""
    return sj.EnvironmentLight(sj.scene.studio(), strength=strength)


def sun(x, y, z, strength=1.0, tint=(1.0, 1.0, 1.0)) -> sj.DirectionalLight:
    """Return a light that comes from a direction; of strength 1 it shows a white diffuser with
    radiance 1.
    """
    return sj.DirectionalLight((-x, -y, -z), np.multiply(tint, strength * np.pi))


def fitted(profile: sj.gaussians.AbstractProfile, eta: float, specular: float, roughness: float):
    """Return a material whose Gaussians are fitted to a profile."""
    gaussians = sj.fit_gaussians(profile, 6, weights=HELD).gaussians
    return sj.Material(gaussians, eta=eta, specular=specular, roughness=roughness)


def transported(medium: sj.Medium, specular: float, roughness: float) -> sj.Material:
    """Return a material fitted to light transport, as `splatjax fit` makes it."""
    with jax.enable_x64(True):
        medium = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), medium)
        made = sj.Material.of_medium(medium, specular=specular, roughness=roughness)
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), made)


def picture(splats, lights, material, eye, target, fov, side, exposure=0.0) -> np.ndarray:
    """Render before a dark wall, lighter below, and return the picture encoded for a display."""
    camera = sj.Camera.look_at(eye, target, fov=fov, width=side, height=side)
    frame = sj.render(sj.Scene(splats, lights, material), camera)
    return before_a_wall(frame.beauty, frame.coverage, exposure)


def before_a_wall(linear, coverage, exposure: float) -> np.ndarray:
    """Encode linear light for a display, before a dark wall."""
    shown = linear_to_srgb(np.asarray(linear, np.float64) * 2.0**exposure)
    wall = np.linspace(0.012, 0.04, len(shown))[:, None, None] * np.asarray([0.9, 1.0, 1.1])
    return shown + linear_to_srgb(wall) * (1 - np.asarray(coverage))[..., None]


def lathe(outline: np.ndarray, sections: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of an outline of radii and heights, turned about the y axis."""
    turned = trimesh.creation.revolve(outline, sections=sections)
    return np.asarray(turned.vertices)[:, [1, 2, 0]], np.asarray(turned.faces)


def covered(vertices: np.ndarray, faces: np.ndarray, count: int) -> sj.Splats:
    """Cover a mesh with splats."""
    return sample_mesh(Mesh(vertices, faces, vertex_normals(vertices, faces)), count)


def smooth(outline: list[tuple[float, float]], step: float = 0.5, width: float = 0.8):
    """Return an open outline from axis to axis in equal steps, its corners rounded over a width;
    mm.
    """
    knots = np.asarray(outline, float)
    line = resampled(knots, int(np.sum(np.linalg.norm(np.diff(knots, axis=0), axis=1)) / step) + 1)
    rounded = gaussian_filter1d(line, width / step, axis=0, mode="nearest")
    rounded[[0, -1], 0] = 0.0
    return rounded


def resampled(line: np.ndarray, count: int) -> np.ndarray:
    """Return so many points of a line, evenly spaced along it."""
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    even = np.linspace(0, along[-1], count)
    return np.stack([np.interp(even, along, column) for column in line.T], axis=-1)


def skin(head, side, eye, target, fov, lights, exposure=0.4, scattering=True) -> np.ndarray:
    """Show a head; eye and target in its heights, from halfway up its foremost."""
    low, high = (np.asarray(limit) for limit in (head.centers.min(0), head.centers.max(0)))
    tall = high[1] - low[1]
    middle = np.asarray([np.mean(np.asarray(head.centers)[:, 0]), low[1] + 0.52 * tall, high[2]])
    eye, target = (middle + tall * np.asarray(place) for place in (eye, target))
    material = sj.load_material("skin").white()
    material = material if scattering else material.opaque()
    return picture(head, lights, material, eye, target, fov, side, exposure)


def marble_bust(_: sj.Splats, side: int) -> np.ndarray:
    """The bust in marble's own color, without its map."""
    bust, marble = sj.bust(250_000).without_maps(), sj.load_material("marble")
    return picture(bust, [dim(1.0)], marble, (230, 20, 640), (0, -40, 0), 30.0, side, -0.3)


def milk_glass(_: sj.Splats, side: int) -> np.ndarray:
    """A fluted vase of milk glass, 3 mm thick, with a lamp inside its rim and daylight from the
    side.
    """
    heights = np.linspace(2, 112, 111)
    knots = [2, 12, 30, 52, 72, 92, 101, 112], [24, 24.5, 33, 39, 36, 25, 22.5, 28]
    radii = CubicSpline(*knots)(heights)
    outer, inner = (np.stack([radii - inset, heights], axis=-1) for inset in (0.0, 2.6))
    outline = smooth([(0, 0), (22, 0), *outer, *inner[:3:-1], (16, 5), (0, 5)])
    vertices, faces = lathe(outline, 360)
    angle = np.arctan2(vertices[:, 0], vertices[:, 2])
    vertices[:, [0, 2]] *= (1 + 0.03 * np.cos(14 * angle))[:, None]
    glass = sj.Medium([0.0015, 0.002, 0.0028], [1.6, 1.9, 2.3], 1.5)
    opal = transported(glass, 1.0, 0.07)
    lamp = sj.PointLight(jnp.asarray([0.0, 60.0, 0.0]), jnp.asarray([7000.0, 4000.0, 1800.0]))
    lights = lamp, dim([0.3, 0.36, 0.42])
    splats = covered(vertices, faces, 300_000)
    return picture(splats, lights, opal, (70, 130, 330), (0, 56, 0), 24.0, side)


def jade(_: sj.Splats, side: int) -> np.ndarray:
    """A disc of jade under a brown skin of half a millimeter, carved with grains, lit from behind
    and from the side.
    """
    inner, outer, half, grain, pitch = 13.0, 44.0, 2.5, 0.9, 6.2
    t = np.linspace(0, 2 * np.pi, 40_001)
    corners = np.stack([np.cos(t), np.sin(t)], axis=-1)
    corners = np.sign(corners) * np.abs(corners) ** (2 / 7)  # a rectangle with round corners
    middle = (inner + outer) / 2
    outline = resampled([middle, 0] + corners * [middle - inner, half], 601)
    vertices, faces = lathe(outline, 1200)
    x, z, y = vertices.T
    radius, row_height = np.hypot(x, y), pitch * np.sqrt(3) / 2
    row = np.round(y / row_height)
    column = np.round(x / pitch - 0.5 * (row % 2)) + 0.5 * (row % 2)
    near = np.hypot(x - pitch * column, y - row * row_height)
    place = np.hypot(pitch * column, row * row_height)
    flat = (place > inner + 4.5) & (place < outer - 4.5)
    raised = np.where(flat, np.exp(-((near / 1.9) ** 4)), 0.0)
    rims = [np.exp(-(((radius - rim) / 0.9) ** 4)) for rim in (outer - 1.4, inner + 1.4)]
    carved = np.maximum(raised, sum(rims)) * (np.abs(z) > 0.9 * half)
    vertices = np.stack([x, y, z + np.sign(z) * grain * carved], axis=-1)
    crust = sj.Layer(sj.Medium([0.3, 0.15, 0.32], [2.4, 2.5, 2.6], 1.6), jnp.asarray(0.4))
    stone = sj.Layer(sj.Medium([0.4, 0.075, 0.21], [0.9, 1.0, 1.1], 1.6), jnp.asarray(jnp.inf))
    material = fitted(sj.LayeredMultipole([crust, stone]), 1.6, 0.9, 0.12)
    lights = (
        sun(0.5, 0.5, -1.0, 3.0, (1.0, 0.95, 0.85)),
        sun(-0.9, 0.8, 0.5, 0.7),
        dim(0.12),
    )
    splats = covered(vertices, faces[:, ::-1], 400_000)
    return picture(splats, lights, material, (-60, 40, 230), (0, 0, 0), 25.0, side, 0.2)


def wax(_: sj.Splats, side: int) -> np.ndarray:
    """A candle that has burnt down a little: its flame stands behind the rim, and the rim glows."""
    wall = [(0, 0), (29, 0), (30, 1.5), (30, 78), (28.5, 80.5), (27, 80), (25.5, 70)]
    vertices, faces = lathe(smooth([*wall, (21, 60), (10, 56), (0, 55.5)]), 480)
    angle = np.arctan2(vertices[:, 0], vertices[:, 2])
    waves = ((3.0, 1, 0.6), (1.4, 3, 0.0), (0.7, 7, 1.0))
    rim = sum(height * np.sin(number * angle + phase) for height, number, phase in waves)
    vertices[:, 1] += np.clip((vertices[:, 1] - 50) / 30, 0, 1) * rim
    candle = sj.Medium([0.0006, 0.0022, 0.009], [0.9, 1.0, 1.15], 1.44)
    paraffin = transported(candle, 0.6, 0.2)
    flame = sj.PointLight(jnp.asarray([0.0, 69.0, 0.0]), jnp.asarray([5200.0, 3400.0, 1700.0]))
    lights = flame, dim([0.06, 0.075, 0.1])
    splats = covered(vertices, faces, 300_000)
    return picture(splats, lights, paraffin, (60, 92, 260), (0, 42, 0), 23.0, side, 0.3)


def inverse(_: sj.Splats, side: int) -> np.ndarray:
    """A photograph, the same body under the coefficients that the search starts from, and under
    those that it finds.
    """
    splats = sj.bust(20_000).without_maps().scaled(0.2)
    lights = sun(-0.9, 0.5, 0.45), sun(0.9, 0.2, -0.6, 0.6)
    eye, target, size = (46, 4, 128), (0, -8, 0), 3 * side // 8
    camera = sj.Camera.look_at(eye, target, fov=30.0, width=size, height=size)

    def render(medium: sj.Medium) -> sj.Frame:
        with jax.enable_x64(True):
            material = fitted(sj.Dipole(medium), 1.5, 0.0, 0.3)
            single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), material)
        return sj.render(sj.Scene(splats, lights, single), camera)

    with jax.enable_x64(True):
        marble, skin = sj.load_medium("marble"), sj.load_medium("skin1")
        start = sj.Medium(skin.sigma_a, skin.sigma_s_prime, marble.eta)
    truth = render(marble)
    rendered = np.asarray(truth.beauty, np.float64)
    deviation = np.full(rendered.shape, 0.01 * np.sqrt(np.mean(rendered**2)))
    photograph = rendered + deviation * np.random.default_rng(0).normal(size=rendered.shape)
    with jax.enable_x64(True):
        observation = sj.inverse.Observation(photograph, camera, lights, deviation=deviation)
        recovery = sj.inverse.recover(
            [observation],
            splats,
            start,
            model=sj.fitting.DiffusionModel(),
            progress=lambda what, _: print(what),
        )
    print(recovery.summary())
    for name in ("sigma_a", "sigma_s_prime"):
        ratio = np.asarray(getattr(recovery.medium, name)) / np.asarray(getattr(marble, name))
        print(f"{name} off by", ratio - 1)
    body = np.asarray(truth.coverage)
    images = np.maximum(photograph, 0), render(start).beauty, render(recovery.medium).beauty
    shown = [before_a_wall(image * (body > 0)[..., None], body, 0.2) for image in images]
    return np.concatenate(shown, axis=1)


KEY = sun(-0.95, 0.55, 0.75, 0.8, (1.0, 0.97, 0.92)), dim(0.3)
FAR = partial(skin, eye=(1.1, 0.1, 2.4), lights=KEY)
FACE = partial(
    skin,
    eye=(0.62, 0.02, 2.1),
    target=(0.07, -0.07, -0.08),
    fov=10.0,
    exposure=0.5,
    lights=KEY,
)
EAR = partial(
    skin,
    eye=(1.7, 0.0, 1.3),
    target=(0.305, -0.02, -0.46),
    fov=7.6,
    exposure=0.3,
    lights=(sun(0.22, 0.25, -1.0, 3.0, (1.0, 0.95, 0.88)), dim(0.2)),
)
PICTURES: dict[str, Callable[[sj.Splats, int], np.ndarray]] = {
    "skin_far": partial(FAR, target=(0, 0, -0.3), fov=21.0),
    "skin_near": partial(FAR, target=(0.10, -0.02, -0.06), fov=8.0),
    "skin_close": partial(FAR, target=(0.084, -0.107, -0.053), fov=4.2),
    "head_skin": FACE,
    "head_plain": partial(FACE, scattering=False),
    "head_ear": EAR,
    "marble_bust": marble_bust,
    "milk_glass": milk_glass,
    "jade": jade,
    "wax": wax,
    "inverse": inverse,
}


def main() -> None:
    """Draw the pictures that are named."""
    parser = argparse.ArgumentParser(prog="python tools/make_gallery.py", description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], help="all by default")
    parser.add_argument("--head", type=Path, help="PLY file of a head; by default the bust")
    parser.add_argument("--side", type=int, default=640, help="of a picture, pixels")
    options = parser.parse_args()
    names = options.names or list(PICTURES)
    head = None
    if any(name.startswith(("head", "skin")) for name in names):
        head = sj.bust(400_000) if options.head is None else sj.read_splats(options.head)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names:
        image = np.uint8(np.round(255 * np.clip(PICTURES[name](head, options.side), 0, 1)))
        Image.fromarray(image).save(FOLDER / f"{name}.png", optimize=True)
        print(FOLDER / f"{name}.png", flush=True)


if __name__ == "__main__":
    main()
