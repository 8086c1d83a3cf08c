"""Make the pictures of docs/gallery.md: `python tools/make_gallery.py [name ...] [--head
head.ply]`, all of them by default.

They land in out/gallery. Those of skin show a scanned head where one is given (docs/gallery.md says
how it is sampled), and the built-in bust otherwise.
"""

import argparse
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline

import splatjax as sj
from splatjax.geometry import Mesh, sample_mesh, vertex_normals
from splatjax.io import linear_to_srgb

FOLDER = Path(__file__).resolve().parents[1] / "out" / "gallery"
HELD = sj.NonNegativeWeights(sj.FixedTotalReflectance())


def sun(
    x: float, y: float, z: float, strength: float = 1.0, tint=(1.0, 1.0, 1.0)
) -> sj.DirectionalLight:
    """Give a light that comes from a direction; of strength 1 it shows a white diffuser with
    radiance 1.
    """
    return sj.DirectionalLight(
        -jnp.asarray([x, y, z]), jnp.asarray(tint, float) * (strength * jnp.pi)
    )


def fill(x: float, y: float, z: float, strength: float) -> sj.DirectionalLight:
    """Give the same without shadows."""
    return sj.DirectionalLight(
        -jnp.asarray([x, y, z]), jnp.full(3, strength * jnp.pi), cast_shadows=False
    )


def looking(eye, target, fov: float, side: int) -> sj.Camera:
    """Give a camera for a square picture."""
    return sj.Camera.look_at(
        jnp.asarray(eye, float), jnp.asarray(target, float), fov=fov, width=side, height=side
    )


def fitted(
    profile: sj.AbstractProfile, eta: float, specular: float, roughness: float
) -> sj.Material:
    """Give a material whose Gaussians are fitted to a profile."""
    gaussians = sj.fit_gaussians(profile, 6, weights=HELD).gaussians
    return sj.Material(gaussians, eta=eta, specular=specular, roughness=roughness)


def medium(sigma_a, sigma_s_prime, eta: float) -> sj.Medium:
    """Give a medium of red, green and blue, 1/mm."""
    return sj.Medium(jnp.asarray(sigma_a), jnp.asarray(sigma_s_prime), jnp.full(3, eta))


def show(picture, exposure: float = 0.0) -> np.ndarray:
    """Give linear light as a display shows it, over black."""
    return np.asarray(linear_to_srgb(np.asarray(picture, np.float64) * 2.0**exposure))


def render(
    splats: sj.Splats,
    lights: tuple,
    material: sj.Material,
    camera: sj.Camera,
    exposure: float = 0.0,
) -> np.ndarray:
    """Render before a dark wall, lighter below, and give the picture as a display shows it."""
    frame = sj.render(sj.Scene(splats, lights, material), camera)
    return before_a_wall(show(frame.beauty, exposure), frame.coverage)


def before_a_wall(shown: np.ndarray, coverage) -> np.ndarray:
    """Put what a display shows before a dark wall."""
    wall = np.linspace(0.012, 0.04, len(shown))[:, None, None] * np.asarray([0.9, 1.0, 1.1])
    return shown + linear_to_srgb(wall) * (1 - np.asarray(coverage))[..., None]


def surface(points: np.ndarray, around: bool = True) -> Mesh:
    """Give the mesh of a grid of points, `[along, around, 3]`: closed around, and along if its
    first row follows its last.
    """
    rows, columns = points.shape[:2]
    i, j = np.meshgrid(np.arange(rows if around else rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = ((i + 1) % rows) * columns + j, ((i + 1) % rows) * columns + (j + 1) % columns
    faces = np.concatenate(
        [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    )
    vertices = points.reshape(-1, 3)
    corners = vertices[faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    mesh = Mesh(vertices, faces[areas > 1e-9], vertex_normals(vertices, faces))
    return mesh if not around or mesh.volume() > 0 else surface(points[::-1], around)


def turned(profile: np.ndarray, columns: int = 360, flutes: int = 0, depth: float = 0.0) -> Mesh:
    """Turn a closed outline of radii and heights about the vertical axis, its radii waved by flutes
    where they are outermost.
    """
    angle = 2 * np.pi * np.arange(columns) / columns
    radius = profile[:, :1] * (1 + depth * np.cos(flutes * angle)[None])
    height = np.broadcast_to(profile[:, 1:], radius.shape)
    return surface(np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=-1))


def smooth(outline: list[tuple[float, float]], step: float = 0.5, width: float = 1.0) -> np.ndarray:
    """Give an open outline from axis to axis in equal steps, its corners rounded over a
    width; mm.
    """
    knots = np.asarray(outline, float)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    at = np.linspace(0, way[-1], int(way[-1] / step) + 1)
    line = np.stack([np.interp(at, way, knots[:, k]) for k in range(2)], axis=-1)
    kernel = np.exp(-0.5 * (np.arange(-3 * width, 3 * width + step, step) / width) ** 2)
    kernel /= kernel.sum()
    edge = len(kernel) // 2
    padded = np.concatenate([line[:1].repeat(edge, 0), line, line[-1:].repeat(edge, 0)])
    rounded = np.stack([np.convolve(padded[:, k], kernel, "valid") for k in range(2)], axis=-1)
    rounded[[0, -1], 0] = 0.0
    return np.maximum(rounded, [[0.0, -np.inf]])


def on(head: sj.Splats, place: tuple[float, float, float]) -> np.ndarray:
    """Give a place in heights of a head, from halfway up its foremost."""
    centers = np.asarray(head.centers)
    low, high = centers.min(axis=0), centers.max(axis=0)
    tall = high[1] - low[1]
    return np.asarray([centers[:, 0].mean(), low[1] + 0.52 * tall, high[2]]) + tall * np.asarray(
        place
    )


def skin(head: sj.Splats, side: int, which: int) -> np.ndarray:
    """A head, its nose and eyes, and the nose's shadow: the same skin from three distances."""
    eye, target = (
        on(head, (1.1, 0.1, 2.4)),
        on(head, ((0, 0, -0.3), (0.10, -0.02, -0.06), (0.084, -0.107, -0.053))[which]),
    )
    lights = (
        sun(-0.9, 0.7, 0.9, 1.0, (1.0, 0.97, 0.92)),
        sun(1.0, 0.1, -0.3, 0.5, (0.8, 0.9, 1.0)),
        fill(0.8, 0, 1, 0.06),
    )
    return render(
        head,
        lights,
        sj.load_material("skin").white(),
        looking(eye, target, (21.0, 8.0, 4.2)[which], side),
        0.4,
    )


def face(head: sj.Splats, side: int, scattering: bool) -> np.ndarray:
    """A face, with light that spreads below its skin or without."""
    eye, target = on(head, (0.62, 0.02, 2.1)), on(head, (0.07, -0.07, -0.08))
    lights = (
        sun(-0.95, 0.55, 0.75, 1.0, (1.0, 0.97, 0.92)),
        sun(1.0, 0.15, -0.45, 0.7, (0.8, 0.9, 1.0)),
        fill(0.8, 0, 1, 0.05),
    )
    material = sj.load_material("skin").white()
    return render(
        head,
        lights,
        material if scattering else material.opaque(),
        looking(eye, target, 10.0, side),
        0.5,
    )


def ear(head: sj.Splats, side: int) -> np.ndarray:
    """An ear with the sun behind it."""
    eye, target = on(head, (1.7, 0.0, 1.3)), on(head, (0.305, -0.02, -0.46))
    lights = (
        sun(0.22, 0.25, -1.0, 3.0, (1.0, 0.95, 0.88)),
        sun(-0.5, 0.4, 1.0, 0.3, (0.8, 0.9, 1.0)),
        fill(1, 0.1, 0.7, 0.11),
    )
    return render(
        head, lights, sj.load_material("skin").white(), looking(eye, target, 7.6, side), 0.3
    )


def marble_bust(_: sj.Splats, side: int) -> np.ndarray:
    """The bust in marble's own color, without its map."""
    bust = sj.bust(250_000)
    plain = sj.Splats(bust.centers, bust.normals, bust.radii, bust.areas)
    lights = (
        sun(-0.8, 0.7, 0.6, 1.1, (1.0, 0.96, 0.9)),
        sun(0.9, 0.2, -0.7, 0.7, (0.75, 0.86, 1.0)),
        fill(0.5, 0, 1, 0.08),
    )
    return render(
        plain,
        lights,
        sj.load_material("marble"),
        looking((230, 20, 640), (0, -40, 0), 30.0, side),
        0.2,
    )


def milk_glass(_: sj.Splats, side: int) -> np.ndarray:
    """A fluted vase of milk glass, 3 mm thick, with a lamp inside its rim and daylight from the
    side.
    """
    heights = np.linspace(2, 112, 111)
    radii = CubicSpline([2, 12, 30, 52, 72, 92, 101, 112], [24, 24.5, 33, 39, 36, 25, 22.5, 28])(
        heights
    )
    walls = [np.stack([radii - inset, heights], axis=-1) for inset in (0.0, 2.6)]
    outline = [(0, 0), (22, 0), *walls[0], *walls[1][:3:-1], (16, 5), (0, 5)]
    vase = turned(smooth(outline, width=0.8), flutes=14, depth=0.03)
    splats = sample_mesh(vase, 300_000)
    opal = fitted(
        sj.BetterDipole(medium([0.0015, 0.002, 0.0028], [1.6, 1.9, 2.3], 1.5)), 1.5, 1.0, 0.07
    )
    lamp = sj.PointLight(jnp.asarray([0.0, 60.0, 0.0]), jnp.asarray([7000.0, 4000.0, 1800.0]))
    lights = lamp, sun(-0.9, 0.6, 0.5, 0.45, (0.75, 0.88, 1.0)), fill(0.6, 0.1, 0.8, 0.04)
    return render(splats, lights, opal, looking((70, 130, 330), (0, 56, 0), 24.0, side), 0.0)


def jade(_: sj.Splats, side: int) -> np.ndarray:
    """A disc of jade under a brown skin of half a millimeter, carved with grains, lit from behind
    and from the side.
    """
    inner, outer, thick, grain = 13.0, 44.0, 5.0, 0.9
    middle, half = (inner + outer) / 2, (outer - inner) / 2
    t, angle = np.linspace(0, 2 * np.pi, 40_001), 2 * np.pi * np.arange(1200) / 1200
    outline = np.stack(
        [np.sign(f(t)) * np.abs(f(t)) ** (2 / 7) for f in (np.cos, np.sin)], axis=-1
    )  # round corners
    way = np.concatenate(
        [[0], np.cumsum(np.linalg.norm(np.diff(outline * [half, thick / 2], axis=0), axis=1))]
    )
    even = np.linspace(0, way[-1], 600, endpoint=False)
    across, up = (np.interp(even, way, outline[:, k]) for k in range(2))
    radius = (middle + half * across)[:, None] + 0 * angle
    height = (thick / 2 * up)[:, None] + 0 * angle
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    pitch = 6.2
    row = np.round(y / (pitch * np.sqrt(3) / 2))
    column = np.round(x / pitch - 0.5 * (row % 2)) + 0.5 * (row % 2)
    near = np.hypot(x - pitch * column, y - row * pitch * np.sqrt(3) / 2)
    at = np.hypot(pitch * column, row * pitch * np.sqrt(3) / 2)
    flat = (at > inner + 4.5) & (at < outer - 4.5)
    raised = np.where(flat, np.exp(-((near / 1.9) ** 4)), 0.0)
    rim = np.exp(-(((radius - outer + 1.4) / 0.9) ** 4)) + np.exp(
        -(((radius - inner - 1.4) / 0.9) ** 4)
    )
    height = height + np.sign(height) * grain * np.maximum(raised, rim) * (
        np.abs(up)[:, None] > 0.9
    )
    disc = surface(np.stack([x, y, height], axis=-1))
    splats = sample_mesh(disc, 400_000)
    crust = sj.Layer(medium([0.04, 0.06, 0.2], [3.0, 3.2, 3.4], 1.55), jnp.asarray(0.4))
    stone = sj.Layer(medium([0.16, 0.022, 0.1], [0.9, 1.0, 1.1], 1.55), jnp.asarray(jnp.inf))
    material = fitted(sj.LayeredMultipole([crust, stone]), 1.6, 0.9, 0.12)
    lights = (
        sun(0.5, 0.5, -1.0, 3.0, (1.0, 0.95, 0.85)),
        sun(-0.9, 0.8, 0.5, 0.8),
        fill(0.7, -0.4, 1, 0.06),
    )
    return render(splats, lights, material, looking((-60, 40, 230), (0, 0, 0), 25.0, side), 0.2)


def wax(_: sj.Splats, side: int) -> np.ndarray:
    """A candle that has burnt down a little: its flame stands behind the rim, and the rim glows."""
    outline = [
        (0, 0),
        (29, 0),
        (30, 1.5),
        (30, 78),
        (28.5, 80.5),
        (27, 80),
        (25.5, 70),
        (21, 60),
        (10, 56),
        (0, 55.5),
    ]
    grid = turned(smooth(outline, width=0.8), columns=480)
    vertices = np.array(grid.vertices)
    angle = np.arctan2(vertices[:, 0], vertices[:, 2])
    tall = np.clip((vertices[:, 1] - 50) / 30, 0, 1)
    vertices[:, 1] += tall * (
        3.0 * np.sin(angle + 0.6) + 1.4 * np.sin(3 * angle) + 0.7 * np.sin(7 * angle + 1)
    )
    candle = Mesh(vertices, grid.faces, vertex_normals(vertices, grid.faces))
    splats = sample_mesh(candle, 300_000)
    paraffin = fitted(
        sj.BetterDipole(medium([0.0006, 0.0022, 0.009], [0.9, 1.0, 1.15], 1.44)), 1.44, 0.6, 0.2
    )
    flame = sj.PointLight(jnp.asarray([0.0, 69.0, 0.0]), jnp.asarray([5200.0, 3400.0, 1700.0]))
    lights = (
        flame,
        sun(-0.8, 0.5, -0.9, 0.25, (0.6, 0.75, 1.0)),
        sun(0.8, 0.5, 0.8, 0.05, (0.6, 0.75, 1.0)),
    )
    return render(splats, lights, paraffin, looking((60, 92, 260), (0, 42, 0), 23.0, side), 0.3)


def inverse(_: sj.Splats, side: int) -> np.ndarray:
    """What was photographed, the same under the coefficients that the search starts from, and under
    those that it finds.
    """
    bust, scale = sj.bust(20_000), 0.2
    splats = sj.Splats(bust.centers, bust.normals, bust.radii, bust.areas).scaled(scale)
    camera = looking((46, 4, 128), (0, -8, 0), 30.0, 3 * side // 8)
    lights = sun(-0.9, 0.5, 0.45), sun(0.9, 0.2, -0.6, 0.6)
    with jax.enable_x64(True):
        marble, skin = sj.load_medium("marble"), sj.load_medium("skin1")
        start = sj.Medium(skin.sigma_a, skin.sigma_s_prime, marble.eta)
        known, guess = (
            single(
                sj.Material(
                    sj.fit_gaussians(sj.Dipole(each), 6, weights=HELD).gaussians,
                    eta=1.5,
                    specular=0.0,
                )
            )
            for each in (marble, start)
        )

    def seen_in(material):
        return sj.render(sj.Scene(splats, lights, material), camera)

    rendered = seen_in(known)
    deviation = 0.01 * float(np.sqrt(np.mean(np.asarray(rendered.beauty) ** 2)))
    photograph = np.asarray(rendered.beauty) + deviation * np.random.default_rng(0).normal(
        size=rendered.beauty.shape
    )
    with jax.enable_x64(True):
        seen = sj.Observation(
            photograph, camera, lights, deviation=np.full(photograph.shape, deviation)
        )
        found = sj.recover(
            [seen], splats, start, progress=lambda said, medium: print(said, flush=True)
        )
    print(found.summary())
    for name in ("sigma_a", "sigma_s_prime"):
        print(
            f"{name} off by",
            np.asarray(getattr(found.medium, name)) / np.asarray(getattr(marble, name)) - 1,
        )
    shown = np.maximum(photograph, 0), seen_in(guess).beauty, seen_in(single(found.material)).beauty
    body = np.asarray(rendered.coverage)[..., None]
    return np.concatenate(
        [before_a_wall(show(each * (body > 0), 0.2), body[..., 0]) for each in shown], axis=1
    )


def single(material: sj.Material) -> sj.Material:
    """Give a material in single precision."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), material)


PICTURES: dict[str, Callable[[sj.Splats, int], np.ndarray]] = {
    "skin_far": functools.partial(skin, which=0),
    "skin_near": functools.partial(skin, which=1),
    "skin_close": functools.partial(skin, which=2),
    "head_skin": functools.partial(face, scattering=True),
    "head_plain": functools.partial(face, scattering=False),
    "head_ear": ear,
    "marble_bust": marble_bust,
    "milk_glass": milk_glass,
    "jade": jade,
    "wax": wax,
    "inverse": inverse,
}


def main() -> None:
    """Draw what is asked for."""
    parser = argparse.ArgumentParser(prog="python tools/make_gallery.py", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(PICTURES)}; all by default")
    parser.add_argument(
        "--head",
        type=Path,
        help="PLY file of a head, for the pictures of skin; the built-in bust by default",
    )
    parser.add_argument(
        "--side", type=int, default=640, help="of a picture, pixels (default %(default)s)"
    )
    given = parser.parse_args()
    if unknown := sorted(set(given.names) - set(PICTURES)):
        parser.error(
            f"{unknown[0]} is no picture of the gallery; give some of {', '.join(PICTURES)}"
        )
    names = given.names or list(PICTURES)
    head = None
    if any(name.startswith(("head", "skin")) for name in names):
        head = sj.bust(400_000) if given.head is None else sj.read_splats(given.head)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names:
        picture = np.uint8(np.round(255 * np.clip(PICTURES[name](head, given.side), 0, 1)))
        Image.fromarray(picture).save(FOLDER / f"{name}.png", optimize=True)
        print(FOLDER / f"{name}.png", flush=True)


if __name__ == "__main__":
    main()
