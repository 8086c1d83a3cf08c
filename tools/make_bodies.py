"""Compare splatted with path-traced bodies, and write the table and picture of docs/bodies.md:
`python tools/make_bodies.py [folder [name ...]]`.

The path-traced pictures are made once, by `python tools/path_traced_bodies.py out/bodies`, which
needs Mitsuba 3.
"""

import dataclasses
import functools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh
from scipy.ndimage import binary_erosion

import splatjax as sj
from splatjax.diffusion import PlainMean, ShapeDiffuser
from splatjax.geometry import Mesh, bust_mesh, sample_mesh, vertex_normals
from splatjax.io import linear_to_srgb

# Pixels along a side, paths per pixel of a pass, and passes.
SIZE, SAMPLES, PASSES = 128, 128, 4
ALBEDO = (0.9, 0.98, 0.998)
SIGMA_T = 1.0  # 1/mm; isotropic scattering
IRRADIANCE = float(np.pi)
Place = tuple[float, float, float]


class Body(NamedTuple):
    """A body under one light. Lengths are mm, and mean free paths.

    The blocker is a black rectangle that faces +z: its center, width and height.
    """

    name: str
    what: str
    shape: Callable[[], trimesh.Trimesh]
    light: sj.scene.AbstractLight
    eye: Place
    target: Place
    fov: float
    count: int
    blocker: tuple[Place, tuple[float, float]] | None = None
    eta: float = 1.0


def head() -> trimesh.Trimesh:
    """Load Lee Perry-Smith's head (CC-BY 3.0), from the folder that SPLATJAX_SHARED names, without
    its facets.
    """
    path = Path("data", "lee_perry_smith", "LeePerrySmith_closed.ply")
    if "SPLATJAX_SHARED" not in os.environ:
        raise ValueError(f"SPLATJAX_SHARED is not set; the head needs the folder with {path}")
    path = Path(os.environ["SPLATJAX_SHARED"]) / path
    return trimesh.load(path, process=False).apply_scale(MM_PER_UNIT).subdivide_loop(2)


def bust() -> trimesh.Trimesh:
    return trimesh.Trimesh(bust_mesh().vertices, bust_mesh().faces, process=False)


def box(depth: float) -> trimesh.Trimesh:
    """Make a box of 40 x 40 mm whose front is z = 0."""
    return trimesh.creation.box([40, 40, depth]).apply_translation([0, 0, -depth / 2])


def lamp(*direction: float) -> sj.DirectionalLight:
    return sj.DirectionalLight(direction, irradiance=[IRRADIANCE] * len(ALBEDO))


MM_PER_UNIT, BLOCKER_DEPTH = 53.0, 0.2
SPHERE, HEAD = "sphere of radius 10", "scanned head"
sphere = functools.partial(trimesh.creation.icosphere, 6, 10.0)
FROM_SPHERE = (0, 0, 80), (0, 0, 0), 18, 150_000
FROM_SHEET = (30, 20, 80), (0, 0, -1), 30, 150_000
FROM_HEAD = (250, 100, 800), (0, 70, 0), 19, 683_549
BUST, FROM_BUST = "the built-in bust", ((250, 0, 800), (0, -40, 0), 22, 300_000)
EAR = (450, 80, 300), (60, 60, 0), 9, 683_549
STUDIO = sj.EnvironmentLight(sj.scene.studio())
KEY = lamp(0.41, -0.574, -0.709)  # from the studio's large softbox
BEHIND = sj.EnvironmentLight(np.roll(sj.scene.studio(), len(sj.scene.studio()), axis=1))
BODIES = [
    Body("sphere", f"{SPHERE}, lit from the side", sphere, lamp(-1, -1, -1), *FROM_SPHERE),
    Body("sphere_key", f"{SPHERE}, lit like the studio's large softbox", sphere, KEY, *FROM_SPHERE),
    Body("sphere_studio", f"{SPHERE} in the studio", sphere, STUDIO, *FROM_SPHERE),
    Body(
        "sphere_refracting",
        f"{SPHERE} in the studio, eta 1.4",
        sphere,
        STUDIO,
        *FROM_SPHERE,
        eta=1.4,
    ),
    Body(
        "sphere_softbox",
        f"{SPHERE} beside a square light of 40 x 40",
        sphere,
        sj.scene.RectangleLight.facing([35, 35, 35], [0, 0, 0], 40, 40, [10.0] * 3),
        *FROM_SPHERE,
    ),
    Body(
        "block",
        "block of 40 x 40 x 20 with a shadow's edge",
        functools.partial(box, 20),
        lamp(0, 0, -1),
        (0, 70, 40),
        (0, 0, -5),
        32,
        200_000,
        ((15, 0, 45), (30, 50)),
    ),
    *(
        Body(
            f"sheet{depth}",
            f"sheet of 40 x 40 x {depth}, lit from behind",
            functools.partial(box, depth),
            lamp(0, 0, 1),
            *FROM_SHEET,
        )
        for depth in (1, 2, 4, 8)
    ),
    *(
        Body(
            f"sheet{depth}_front",
            f"sheet of 40 x 40 x {depth}, lit from the front",
            functools.partial(box, depth),
            lamp(0, 0, -1),
            *FROM_SHEET,
        )
        for depth in (2, 4, 8)
    ),
    Body(
        "sheet4_refracting",
        "sheet of 40 x 40 x 4 before the studio, eta 1.4",
        functools.partial(box, 4),
        BEHIND,
        *FROM_SHEET,
        eta=1.4,
    ),
    Body(
        "block_refracting",
        "block of 40 x 40 x 20 in the studio, eta 1.4",
        functools.partial(box, 20),
        STUDIO,
        *((0, 70, 40), (0, 0, -5), 32, 200_000),
        eta=1.4,
    ),
    Body("head", f"{HEAD}, lit from the front", head, lamp(-0.7, -0.5, -1), *FROM_HEAD),
    Body("head_key", f"{HEAD}, lit like the studio's large softbox", head, KEY, *FROM_HEAD),
    Body("head_studio", f"{HEAD} in the studio", head, STUDIO, *FROM_HEAD),
    Body("head_refracting", f"{HEAD} in the studio, eta 1.4", head, STUDIO, *FROM_HEAD, eta=1.4),
    Body(
        "head_softbox",
        f"{HEAD} beside a square light of 300 x 300",
        head,
        sj.scene.RectangleLight.facing([250, 250, 350], [0, 70, 0], 300, 300, [10.0] * 3),
        *FROM_HEAD,
    ),
    Body("bust", f"{BUST}, lit from the front", bust, lamp(-0.7, -0.5, -1), *FROM_BUST),
    *(
        Body(f"bust_{name}", f"{BUST}, lit like the studio's {what}", bust, light, *FROM_BUST)
        for name, what, light in (
            ("key", "large softbox", KEY),
            ("fill", "weak softbox", lamp(-0.962, -0.087, -0.258)),
            ("rim", "strip behind", lamp(-0.453, -0.423, 0.785)),
        )
    ),
    Body("bust_studio", f"{BUST} in the studio", bust, STUDIO, *FROM_BUST),
    Body(
        "bust_softbox",
        f"{BUST} beside a square light of 300 x 300",
        bust,
        sj.scene.RectangleLight.facing([250, 180, 350], [0, -30, 0], 300, 300, [10.0] * 3),
        *FROM_BUST,
    ),
    Body("ear", f"ear of the {HEAD}, lit from behind", head, lamp(-0.45, -0.25, 1), *EAR),
    Body(
        "ear_refracting",
        f"ear of the {HEAD} before the studio, eta 1.4",
        head,
        BEHIND,
        *EAR,
        eta=1.4,
    ),
]

# A frame of the solved head takes one to two minutes.
UNSOLVED = (
    *("head_key", "head_studio", "head_softbox"),
    *("bust", "bust_key", "bust_fill", "bust_rim", "bust_studio", "bust_softbox"),
)
PICTURED = "sphere", "sphere_refracting", "sheet4", "head", "head_refracting"
PAGE = Path(__file__).parents[1] / "docs" / "bodies.md"
BEGIN, END = "<!-- table: tools/make_bodies.py -->", "<!-- end of table -->"
TITLES = ("body", "model", "error: red, green, blue", "inside", "FLIP", "seconds")
TITLES += ("paths per pixel to the same error",)


class Truth(NamedTuple):
    """A path-traced picture, the variance that is left of its noise, and its paths per pixel.

    Pixels count where they are sound: the others are few, each made brighter than all light by one
    stray path in a hundred million. Shown at the exposure, bright parts are 0.8.
    """

    picture: np.ndarray
    variance: np.ndarray
    paths: int
    sound: np.ndarray
    exposure: float


def read_truth(body: Body, folder: Path) -> Truth:
    """Read what `tools/path_traced_bodies.py` wrote."""
    path = folder / f"{body.name}.npz"
    if not path.exists():
        raise FileNotFoundError(f"{path}: is missing; run tools/path_traced_bodies.py {folder}")
    with np.load(path) as file:
        passes = int(file["passes"])
        mean, squares = file["total"] / passes, file["squares"] / passes
    variance = np.maximum((squares - mean**2) / (passes - 1), 0)
    bright = np.quantile(mean, 0.98, axis=(0, 1))
    sound = np.all(np.sqrt(variance) < 0.25 * bright, axis=-1)
    return Truth(mean, variance, passes * SAMPLES, sound, 0.8 / float(np.quantile(mean, 0.98)))


@functools.cache
def models(eta: float) -> dict[str, tuple[sj.Material, sj.RenderSettings]]:
    """Return what is compared: material and settings, by name."""
    albedo = jnp.asarray(ALBEDO)
    medium = sj.Medium(SIGMA_T * (1 - albedo), SIGMA_T * albedo, eta)
    model = sj.fitting.TransportModel()
    half_space, beam = model.half_space(medium), model.profile(medium)
    single = beam.single_scattered()
    apart = single.directional_albedo(jnp.asarray(half_space.cosines()))
    flat = fitted(beam, eta)
    whole, solved = (
        dataclasses.replace(flat, angles=model.angles(medium)),
        dataclasses.replace(flat, medium=medium),
    )
    parted = dataclasses.replace(
        fitted(beam.multiply_scattered(), eta),
        single_scattering=single,
        angles=half_space.angular_law(apart),
    )
    plain = sj.RenderSettings()
    return {
        "the paper's mean": (flat, dataclasses.replace(plain, kernel=PlainMean())),
        "escape normalization and angles": (whole, plain),
        "and single scattering": (parted, plain),
        "and a bounce": (parted, dataclasses.replace(plain, bounces=1)),
        "and two bounces": (parted, dataclasses.replace(plain, bounces=2)),
        "the diffusion equation": (solved, dataclasses.replace(plain, diffuser=ShapeDiffuser())),
        "the same and two bounces": (
            solved,
            dataclasses.replace(plain, diffuser=ShapeDiffuser(), bounces=2),
        ),
    }


def fitted(profile: sj.gaussians.AbstractProfile, eta: float) -> sj.Material:
    """Fit six Gaussians as `splatjax fit` does; the surface is as smooth as it can be, and has no
    highlight.
    """
    weights = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
    with jax.enable_x64(True):
        profile = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), profile)
        fit = sj.fit_gaussians(profile, 6, weights=weights, rule=sj.fitting.TransportModel.rule)
    gaussians = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), fit.gaussians)
    return sj.Material(gaussians, eta=eta, specular=0.0, roughness=0.05)


def splats_of(body: Body) -> sj.Splats:
    """Cover a body and its blocker: black splats so far away that no light spreads to the body."""
    splats = covered(body.shape(), body.count)
    if body.blocker is None:
        return splats
    center, size = body.blocker
    blocker = trimesh.creation.box([*size, BLOCKER_DEPTH]).apply_translation(center)
    return jax.tree.map(
        lambda *parts: jnp.concatenate(parts), splats, covered(blocker, body.count // 4)
    )


def covered(mesh: trimesh.Trimesh, count: int) -> sj.Splats:
    """Cover a mesh, the edges of a box kept sharp."""
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    if len(faces) == 12:  # of a box
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    return sample_mesh(Mesh(vertices, faces, vertex_normals(vertices, faces)), count)


def splatted(
    body: Body, splats: sj.Splats, material: sj.Material, settings: sj.RenderSettings
) -> tuple[np.ndarray, float]:
    """Return the picture, and the seconds that it takes once compiled."""
    camera = sj.Camera.look_at(body.eye, body.target, fov=body.fov, width=SIZE, height=SIZE)
    scene = sj.Scene(splats, (body.light,), material)
    plan = sj.make_plan(scene, camera, settings)
    for _ in range(2):
        start = time.perf_counter()
        frame = jax.block_until_ready(sj.render(scene, camera, settings, plan))
        seconds = time.perf_counter() - start
    return np.asarray(frame.beauty, np.float64), seconds


def row(what: str, name: str, truth: Truth, picture: np.ndarray, seconds: float) -> str:
    """Return a row of the table: per channel the root mean square error over that of the truth,
    whose noise is subtracted; the same without 3 pixels along the outline; the FLIP error; the
    seconds; and the paths per pixel with which the path tracer's noise is as large.
    """
    import flip_evaluator

    power = (truth.picture[truth.sound] ** 2).mean(0)
    noise = truth.variance[truth.sound].mean(0)
    inner = binary_erosion(picture.any(axis=-1), iterations=3) & truth.sound
    errors = (picture - truth.picture) ** 2 - truth.variance
    rms, inside = (
        np.sqrt(np.maximum(errors[mask].mean(0), 0) / (truth.picture[mask] ** 2).mean(0))
        for mask in (truth.sound, inner)
    )
    masked = (truth.exposure * truth.sound[..., None] * image for image in (truth.picture, picture))
    shown = [linear_to_srgb(image).astype(np.float32) for image in masked]
    flip = float(flip_evaluator.evaluate(*shown, "LDR")[1])
    equal = truth.paths * (noise / power).mean() / np.mean(np.square(rms))
    cells = (", ".join(f"{100 * value:.1f}" for value in values) + "%" for values in (rms, inside))
    return line(what, name, *cells, f"{flip:.3f}", f"{seconds:.2f}", f"{equal:.0f}")


def line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def draw(shown: list[tuple[Truth, dict[str, np.ndarray]]], path: Path) -> None:
    """Draw every body: the truth, the models, and by how much each is off."""
    names = list(shown[0][1])
    titles = ["path traced", *names, *(f"{name}, difference" for name in names)]
    size = 2.2 * len(titles), 2.25 * len(shown)
    figure, grid = plt.subplots(len(shown), len(titles), figsize=size, squeeze=False)
    for axes, (truth, pictures) in zip(grid, shown, strict=True):
        images = [linear_to_srgb(truth.exposure * x) for x in (truth.picture, *pictures.values())]
        differences = [truth.exposure * (x - truth.picture) for x in pictures.values()]
        images += [np.clip(0.5 + difference, 0, 1) for difference in differences]
        for axis, image in zip(axes, images, strict=True):
            axis.imshow(image, interpolation="nearest")
            axis.set_axis_off()
    for axis, title in zip(grid[0], titles, strict=True):
        axis.set_title(title, fontsize=8)
    figure.tight_layout(pad=0.2)
    figure.savefig(path, dpi=100)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/bodies")
    chosen = [body for body in BODIES if len(sys.argv) < 3 or body.name in sys.argv[2:]]
    shown = []
    rows = [BEGIN, "", line(*TITLES), line(*["---"] * len(TITLES))]
    for body in chosen:
        truth, splats, pictures = read_truth(body, folder), splats_of(body), {}
        print(f"{body.name}: {np.sum(~truth.sound)} pixels of the truth left out", flush=True)
        has_folds = body.shape in (head, bust)
        for name, (material, settings) in models(body.eta).items():
            is_solved = isinstance(settings.diffuser, ShapeDiffuser)
            if (settings.bounces and not has_folds) or (is_solved and body.name in UNSOLVED):
                continue
            pictures[name], seconds = splatted(body, splats, material, settings)
            rows.append(
                row(body.what if len(pictures) == 1 else "", name, truth, pictures[name], seconds)
            )
            print(rows[-1], flush=True)
        if body.name in PICTURED:
            last = "and two bounces" if has_folds else "and single scattering"
            columns = {"the default": "escape normalization and angles", "all terms": last}
            shown.append((truth, {title: pictures[name] for title, name in columns.items()}))
        jax.clear_caches()  # the programs of all bodies are more than one process may hold
    if shown:
        draw(shown, folder / "bodies.webp")
    if chosen == BODIES:
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        table = "\n".join([*rows, "", END])
        PAGE.write_text(before + table + rest.split(END)[1], encoding="utf-8")
        draw(shown, PAGE.parent / "images" / "bodies.webp")


if __name__ == "__main__":
    main()
