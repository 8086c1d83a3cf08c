"""Compare splatted with path-traced bodies, and write the table and picture of docs/bodies.md:
`python tools/make_bodies.py`.

The path-traced pictures are made once, by `python tools/path_traced_bodies.py out/bodies`, which
needs Mitsuba 3.
"""

import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import trimesh

import splatjax as sj
from splatjax.diffusion import DiffusionSettings, PlainMean
from splatjax.geometry import Mesh, sample_mesh, vertex_normals
from splatjax.splatting import SplattingSettings

SIZE = 192
"""Pixels along a side."""
SAMPLES, PASSES = 256, 9
"""Paths per pixel of a pass, and passes."""
ALBEDO = (0.9, 0.98, 0.998)
SIGMA_T = 1.0
"""1/mm; isotropic scattering, and no change of index at the surface."""
IRRADIANCE = float(np.pi)


class Body(NamedTuple):
    """A body under one directional light. Lengths are mm, and mean free paths."""

    name: str
    what: str
    light: tuple[float, float, float]
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    count: int
    blocker: tuple[tuple[float, float, float], tuple[float, float]] | None = None
    """Center, width and height of a black rectangle that faces +z."""


BODIES = [
    Body(
        "sphere",
        "sphere of radius 10, lit from the side",
        (-1, -1, -1),
        (0, 0, 80),
        (0, 0, 0),
        18,
        150_000,
    ),
    Body(
        "block",
        "block of 40 x 40 x 20 with a shadow's edge",
        (0, 0, -1),
        (0, 70, 40),
        (0, 0, -5),
        32,
        200_000,
        ((15, 0, 45), (30, 50)),
    ),
    Body(
        "sheet",
        "sheet of 40 x 40 x 2, lit from behind",
        (0, 0, 1),
        (30, 20, 80),
        (0, 0, 0),
        30,
        150_000,
    ),
    Body(
        "head",
        "scanned head, lit from the front",
        (-0.7, -0.5, -1),
        (250, 100, 800),
        (0, 70, 0),
        19,
        683_549,
    ),
    Body(
        "ear",
        "its ear, lit from behind",
        (-0.45, -0.25, 1),
        (450, 80, 300),
        (60, 60, 0),
        9,
        683_549,
    ),
]
"""The head is Lee Perry-Smith's (CC-BY 3.0), from the folder that SPLATJAX_SHARED names."""
MM_PER_UNIT = 53.0
PHOTONS = 4_000_000
EVEN = 1.0
"""Full coverage of splats as evenly spread as these; outlines then lie within 0.2 pixels of the
truth, with the default 0.7.
"""

PAGE = Path(__file__).parents[1] / "docs" / "bodies.md"
PICTURE = PAGE.parent / "images" / "bodies.png"
BEGIN, END = "<!-- table: tools/make_bodies.py -->", "<!-- end of table -->"
HEAD = (
    "| body | model | red off by | green | blue | FLIP | seconds | path tracer's "
    "seconds to the same error |"
)


def mesh_of(body: Body) -> trimesh.Trimesh:
    """Give the closed mesh of a body, mm; sharp edges have vertices of their own."""
    match body.name:
        case "sphere":
            return trimesh.creation.icosphere(6, 10.0)
        case "block":
            mesh = trimesh.creation.box([40, 40, 20])
            mesh.apply_translation([0, 0, -10])
            return mesh
        case "sheet":
            return trimesh.creation.box([40, 40, 2])
    shared = os.environ.get("SPLATJAX_SHARED")
    if shared is None:
        raise ValueError(
            "SPLATJAX_SHARED: is not set; the head needs the folder with data/lee_perry_smith"
        )
    path = Path(shared) / "data" / "lee_perry_smith" / "LeePerrySmith_closed.ply"
    mesh = trimesh.load(path, process=False)
    mesh.apply_scale(MM_PER_UNIT)
    return mesh


class Truth(NamedTuple):
    """A path-traced picture, with what is left of its noise."""

    picture: np.ndarray
    variance: np.ndarray
    """Of the picture."""
    seconds: float

    def sound(self) -> np.ndarray:
        """Tell which pixels count: not the few that one stray path in a hundred million makes
        brighter than all light.
        """
        deviation, bright = np.sqrt(self.variance), np.quantile(self.picture, 0.98, axis=(0, 1))
        return np.all(deviation < 0.25 * bright, axis=-1)

    def exposure(self) -> float:
        """Give the factor at which the picture is shown: its bright parts are 0.8."""
        return 0.8 / float(np.quantile(self.picture, 0.98))


def read_truth(body: Body, folder: Path) -> Truth:
    """Read what `tools/path_traced_bodies.py` wrote."""
    path = folder / f"{body.name}.npz"
    if not path.exists():
        raise FileNotFoundError(
            f"{path}: there is no such file; run tools/path_traced_bodies.py {folder} first"
        )
    with np.load(path) as found:
        passes = int(found["passes"])
        mean = found["total"] / passes
        variance = (found["squares"] / passes - mean**2) / (passes - 1)
        return Truth(mean, np.maximum(variance, 0), float(found["seconds"]) * passes)


def medium() -> sj.Medium:
    """Give the medium of the bodies."""
    albedo = jnp.asarray(ALBEDO)
    return sj.Medium(SIGMA_T * (1 - albedo), SIGMA_T * albedo, jnp.ones(len(ALBEDO)))


def material(profile: sj.Tabulated, single: sj.SingleScattering | None = None) -> sj.Material:
    """Fit six Gaussians to a reflectance, its total held; nothing is reflected by the surface
    itself.
    """
    profile = profile if single is None else profile.without(single)
    with jax.enable_x64(True):
        reference = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), profile)
        fit = sj.fit_gaussians(
            reference,
            6,
            weights=sj.NonNegativeWeights(sj.FixedTotalReflectance()),
            rule=sj.L2_QUADRATURE.beyond(0.2 / SIGMA_T),
        )
        gaussians = jax.tree.map(np.asarray, fit.gaussians)
    return sj.Material(
        jax.tree.map(jnp.asarray, gaussians), eta=1.0, specular=0.0, single_scattering=single
    )


def splats_of(body: Body) -> sj.Splats:
    """Cover a body, its edges kept sharp, and its blocker: black splats so far away that no light
    spreads to the body.
    """
    mesh = mesh_of(body)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    if body.name in ("block", "sheet"):
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    splats = sample_mesh(Mesh(vertices, faces, vertex_normals(vertices, faces)), body.count)
    if body.blocker is None:
        return splats
    (x, y, z), (width, height) = body.blocker
    corners = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, height / 2)
    vertices = np.column_stack([corners[:, 0] + x, corners[:, 1] + y, np.full(4, z)])
    faces = np.asarray([[0, 1, 2], [0, 2, 3]])
    blocker = sample_mesh(Mesh(vertices, faces, vertex_normals(vertices, faces)), body.count // 4)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), splats, blocker)


def splatted(
    body: Body, splats: sj.Splats, material: sj.Material, settings: sj.RenderSettings
) -> tuple[np.ndarray, float]:
    """Give the picture, and the seconds that it takes once compiled."""
    light = sj.DirectionalLight(jnp.asarray(body.light, float), jnp.full(len(ALBEDO), IRRADIANCE))
    eye, target = (jnp.asarray(place, float) for place in (body.eye, body.target))
    camera = sj.Camera.look_at(eye, target, fov=body.fov, width=SIZE, height=SIZE)
    scene = sj.Scene(splats, (light,), material)
    plan = sj.plan(scene, camera, settings)
    jax.block_until_ready(sj.render(scene, camera, settings, plan))
    start = time.perf_counter()
    frame = jax.block_until_ready(sj.render(scene, camera, settings, plan))
    seconds = time.perf_counter() - start
    return np.asarray(frame.beauty, np.float64), seconds


def errors(picture: np.ndarray, truth: Truth) -> tuple[list[float], float]:
    """Give per channel the root mean square error over that of the truth, the truth's noise taken
    out; and the FLIP error.
    """
    sound = truth.sound()
    noise = truth.variance[sound].mean(0)
    squared = ((picture - truth.picture)[sound] ** 2).mean(0) - noise
    rms = np.sqrt(np.maximum(squared, 0) / (truth.picture[sound] ** 2).mean(0))
    import flip_evaluator

    pictures = (
        np.where(sound[..., None], truth.exposure() * each, 0) for each in (truth.picture, picture)
    )
    shown = [encode(each).astype(np.float32) for each in pictures]
    return rms.tolist(), float(flip_evaluator.evaluate(*shown, "LDR")[1])


def encode(linear: np.ndarray) -> np.ndarray:
    """Give a picture as a display wants it (sRGB)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def models() -> dict[str, tuple[sj.Material, sj.RenderSettings]]:
    """Give what is compared: material and settings, by name."""
    found = sj.monte_carlo(
        [sj.Layer(medium(), jnp.asarray(jnp.inf))], PHOTONS, jax.random.key(4)
    ).profile()
    whole, parted = material(found), material(found, sj.SingleScattering(medium()))
    even = SplattingSettings(full_coverage=EVEN)
    plain = sj.RenderSettings(even, diffusion=DiffusionSettings(normalization=PlainMean()))
    return {
        "the paper's mean": (whole, plain),
        "exit odds": (whole, sj.RenderSettings(even)),
        "and single scattering": (parted, sj.RenderSettings(even)),
    }


def row(body: Body, name: str, truth: Truth, picture: np.ndarray, seconds: float) -> str:
    """Give a row of the table."""
    rms, flip = errors(picture, truth)
    sound = truth.sound()
    noise = (truth.variance[sound].mean(0) / (truth.picture[sound] ** 2).mean(0)).mean()
    equal = truth.seconds * noise / np.mean(np.square(rms))
    channels = " | ".join(f"{100 * value:.1f}%" for value in rms)
    return f"| {body.what} | {name} | {channels} | {flip:.3f} | {seconds:.2f} | {equal:.1f} |"


def draw(shown: list[tuple[Body, Truth, dict[str, np.ndarray]]], path: Path) -> None:
    """Draw every body: the truth, the models, and by how much each is off."""
    names = list(shown[0][2])
    columns = ["path traced", *names, *(f"{name}, difference" for name in names)]
    figure, axes = plt.subplots(
        len(shown), len(columns), figsize=(2.2 * len(columns), 2.25 * len(shown)), squeeze=False
    )
    for axes_row, (body, truth, pictures) in zip(axes, shown, strict=True):
        exposure = truth.exposure()
        images = [
            encode(exposure * truth.picture),
            *(encode(exposure * each) for each in pictures.values()),
        ]
        images += [
            np.clip(0.5 + exposure * (each - truth.picture), 0, 1) for each in pictures.values()
        ]
        for axis, image, title in zip(axes_row, images, columns, strict=True):
            axis.imshow(image, interpolation="nearest")
            axis.set_axis_off()
            axis.set_title(title if body is shown[0][0] else "", fontsize=8)
    figure.tight_layout(pad=0.2)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/bodies")
    chosen = [body for body in BODIES if len(sys.argv) < 3 or body.name in sys.argv[2:]]
    compared = models()
    rows, shown = [], []
    for body in chosen:
        truth, splats, pictures = read_truth(body, folder), splats_of(body), {}
        print(f"{body.name}: {np.sum(~truth.sound())} pixels of the truth left out", flush=True)
        for name, (material, settings) in compared.items():
            pictures[name], seconds = splatted(body, splats, material, settings)
            rows.append(row(body, name, truth, pictures[name], seconds))
            print(rows[-1], flush=True)
        shown.append((body, truth, pictures))
    draw(shown, folder / "bodies.png")
    if chosen == BODIES:
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        table = "\n".join(
            [BEGIN, "", HEAD, "|" + " --- |" * HEAD.count(" | ") + " --- |", *rows, "", END]
        )
        PAGE.write_text(before + table + rest.split(END)[1], encoding="utf-8")
        draw(shown, PICTURE)


if __name__ == "__main__":
    main()
