"""Path-trace the bodies of `tools/make_bodies.py` with Mitsuba 3: `python
tools/path_traced_bodies.py FOLDER [NAME ...]`.

Needs `mitsuba` (the dependency group `truth`). A body whose file FOLDER/NAME.npz is there already
is kept: remove the file to trace it again.
"""

import sys
from pathlib import Path

import numpy as np
from make_bodies import ALBEDO, BODIES, PASSES, SAMPLES, SIGMA_T, SIZE, Body
from rich.progress import track

import splatjax as sj
from splatjax.io import atomic_path


def scene(mi, body: Body, mesh: Path, albedo=ALBEDO):
    """Describe a medium of isotropic scattering inside a boundary that is smooth, or, at index 1,
    neither reflects nor bends; lights are not seen themselves. The albedo is red, green and blue,
    or the description of a volume.
    """
    transform = mi.ScalarTransform4f
    medium = {
        "type": "homogeneous",
        "sigma_t": SIGMA_T,
        "albedo": albedo if isinstance(albedo, dict) else {"type": "rgb", "value": list(albedo)},
        "phase": {"type": "isotropic"},
    }
    view = transform().look_at(origin=list(body.eye), target=list(body.target), up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    description = {
        "type": "scene",
        "integrator": {
            "type": "volpath",
            "max_depth": 4000,
            "rr_depth": 400,
            "hide_emitters": True,
        },
        "body": {
            "type": "ply",
            "filename": str(mesh),
            "face_normals": True,
            "bsdf": {"type": "null"}
            if body.eta == 1
            else {"type": "dielectric", "int_ior": body.eta, "ext_ior": 1.0},
            "interior": medium,
        },
        "light": emitter(mi, body.light),
        "camera": {
            "type": "perspective",
            "fov": body.fov,
            "fov_axis": "y",
            "to_world": view,
            "film": film,
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


def emitter(mi, light: sj.scene.AbstractLight) -> dict:
    """Describe a light; the latitude-longitude maps of both renderers are the same."""
    if isinstance(light, sj.DirectionalLight):
        irradiance = {"type": "rgb", "value": np.asarray(light.irradiance).tolist()}
        direction = np.asarray(light.direction).tolist()
        return {"type": "directional", "direction": direction, "irradiance": irradiance}
    if isinstance(light, sj.EnvironmentLight):
        return {"type": "envmap", "bitmap": mi.Bitmap(np.array(light.radiance(), np.float32))}
    across, down = np.asarray(light.edges) / 2
    matrix = np.eye(4)
    matrix[:3] = np.stack([across, down, np.cross(across, down), light.center], axis=1)
    radiance = {"type": "rgb", "value": np.asarray(light.radiance).tolist()}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix),
        "emitter": {"type": "area", "radiance": radiance},
    }


def trace(mi, body: Body, path: Path, albedo=ALBEDO) -> None:
    """Write the sums of the passes and of their squares. What a smooth boundary reflects, and the
    light that passes unscattered, are traced in a black medium and subtracted.
    """
    mesh = path.with_suffix(".ply")
    body.shape().export(mesh)
    described, total, squares = scene(mi, body, mesh, albedo), 0.0, 0.0
    black = scene(mi, body, mesh, (0.0, 0.0, 0.0))
    passes = PASSES if body.eta == 1 else 4 * PASSES  # without connections to the lights
    for number in track(range(passes), description=body.name):
        picture = np.array(mi.render(described, spp=SAMPLES, seed=number), np.float64)
        if body.eta != 1:
            picture -= np.array(mi.render(black, spp=SAMPLES, seed=number), np.float64)
        if not np.isfinite(picture).all():
            raise ValueError(f"{path}: pass {number} has values that are not finite")
        total, squares = total + picture, squares + picture**2
    with atomic_path(path) as temporary:
        np.savez(temporary, total=total, squares=squares, passes=passes)


def main() -> None:
    import mitsuba as mi

    mi.set_variant(next(v for v in ("llvm_ad_rgb", "scalar_rgb") if v in mi.variants()))
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/bodies")
    folder.mkdir(parents=True, exist_ok=True)
    for body in BODIES:
        if sys.argv[2:] and body.name not in sys.argv[2:]:
            continue
        path = folder / f"{body.name}.npz"
        if not path.exists():
            trace(mi, body, path)


if __name__ == "__main__":
    main()
