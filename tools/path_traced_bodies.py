"""Path-trace the bodies of `tools/make_bodies.py` with Mitsuba 3: `python
tools/path_traced_bodies.py FOLDER`.

Needs `mitsuba` (the dependency group `truth`). What is there already is kept, and continued where
it broke off: each pass is added to FOLDER/NAME.npz, written beside and renamed. The time kept is
that of the fastest pass.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from make_bodies import ALBEDO, BODIES, IRRADIANCE, PASSES, SAMPLES, SIGMA_T, SIZE, Body, mesh_of
from rich.progress import track


def scene(mi, body: Body, mesh: Path):
    """A medium inside a boundary that neither reflects nor bends; isotropic scattering; one
    directional light.
    """
    transform = mi.ScalarTransform4f
    albedo = {"type": "rgb", "value": list(ALBEDO)}
    medium = {
        "type": "homogeneous",
        "sigma_t": SIGMA_T,
        "albedo": albedo,
        "phase": {"type": "isotropic"},
    }
    boundary = {"type": "null"}
    description = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 4000, "rr_depth": 400},
        "body": {
            "type": "ply",
            "filename": str(mesh),
            "face_normals": True,
            "bsdf": boundary,
            "interior": medium,
        },
        "light": {
            "type": "directional",
            "direction": list(body.light),
            "irradiance": {"type": "rgb", "value": [IRRADIANCE] * len(ALBEDO)},
        },
        "camera": {
            "type": "perspective",
            "fov": body.fov,
            "fov_axis": "y",
            "to_world": transform().look_at(
                origin=list(body.eye), target=list(body.target), up=[0, 1, 0]
            ),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
    }
    if body.blocker is not None:
        (x, y, z), (width, height) = body.blocker
        description["blocker"] = {
            "type": "rectangle",
            "to_world": transform().translate([x, y, z]).scale([width / 2, height / 2, 1]),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        }
    return mi.load_dict(description)


def trace(mi, body: Body, folder: Path) -> None:
    """Add passes to the body's file until there are enough."""
    path = folder / f"{body.name}.npz"
    total, squares, seconds, passes = 0.0, 0.0, np.inf, 0
    made_of = repr((body, SIZE, SAMPLES, ALBEDO, SIGMA_T, IRRADIANCE))
    if path.exists():
        with np.load(path) as found:
            if str(found["made_of"]) != made_of:
                raise ValueError(
                    f"{path}: is the picture of another body or setting; remove it, or take "
                    "another folder"
                )
            total, squares, seconds, passes = (
                found["total"],
                found["squares"],
                float(found["seconds"]),
                int(found["passes"]),
            )
    mesh = folder / f"{body.name}.ply"
    mesh_of(body).export(mesh)
    made = scene(mi, body, mesh)
    for number in track(range(passes, PASSES), description=body.name):
        start = time.perf_counter()
        picture = np.array(mi.render(made, spp=SAMPLES, seed=number), np.float64)
        seconds = min(seconds, time.perf_counter() - start)
        if not np.isfinite(picture).all():
            raise ValueError(f"{path}: pass {number} has values that are not finite")
        total, squares = total + picture, squares + picture**2
        beside = path.with_suffix(".part.npz")
        np.savez(
            beside,
            total=total,
            squares=squares,
            seconds=seconds,
            passes=number + 1,
            made_of=made_of,
        )
        os.replace(beside, path)


def main() -> None:
    import mitsuba as mi

    mi.set_variant(next(v for v in ("llvm_ad_rgb", "scalar_rgb") if v in mi.variants()))
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/bodies")
    folder.mkdir(parents=True, exist_ok=True)
    for body in BODIES:
        trace(mi, body, folder)


if __name__ == "__main__":
    main()
