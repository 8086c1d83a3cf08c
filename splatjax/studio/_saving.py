"""The files that a studio saves in one folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatjax.io import (
    atomic_path,
    plain_material,
    save_material,
    save_scene,
    write_exr,
    write_png,
    write_toml,
)
from splatjax.scattering import Skin

from ._controls import Controls
from ._session import Session

# Suffixes by kind of file.
SUFFIXES = {"PNG": [".png"], "EXR": [".exr"], "material": [".toml"], "scene": [".toml", ".py"]}
# Returns the contents of a scene file in a folder, from material, lights and camera.
AsFile = Callable[..., dict[str, Any]]
_PROGRAM = '''"""Render {name}.png of the scene in {name}.toml, beside this file."""

from pathlib import Path

import splatjax as sj

sj.cache.keep()
here = Path(__file__).parent
scene, camera, settings = sj.io.load_scene(here / "{name}.toml")
frame = sj.render(scene, camera, settings)
wavelengths = scene.material.wavelengths
sj.write_png(here / "{name}.png", frame, exposure={exposure}, wavelengths=wavelengths)
'''


def save(
    session: Session,
    controls: Controls,
    folder: str | Path,
    kind: str,
    as_file: AsFile | None = None,
) -> list[Path]:
    """Write the picture (PNG), all its layers (EXR), the material, or the scene and a program that
    renders it, under the next free number.

    **Arguments:**

    - `folder`: created if missing.
    - `as_file`: returns the contents of a scene file from a folder, material, lights and camera,
      with references to existing files of the body and the lights. Without it, these files are
      written too.

    **Returns:** the paths of the files.

    **Raises:** `KeyError` for any other kind; `OSError` if a file cannot be written.
    """
    session.picture(controls)  # fits variances and angles to the coefficients
    scene, camera = session.scene(controls), session.camera(controls)
    optics, folder = session.optics(controls), Path(folder)
    skin = optics if isinstance(optics, Skin) and controls.has_fitted_weights else None
    record = None
    if as_file is not None:
        record = as_file(folder, scene.material, scene.lights, camera)
        record["material"] = plain_material(scene.material, skin, g=controls.g)
    folder.mkdir(exist_ok=True)
    taken = {path.stem for path in folder.iterdir()}
    name = next(name for n in range(len(taken) + 1) if (name := f"studio_{n:03}") not in taken)
    paths = [folder / f"{name}{suffix}" for suffix in SUFFIXES[kind]]
    if kind == "PNG":
        write_png(
            paths[0],
            session.frame(controls),
            exposure=controls.exposure,
            wavelengths=scene.material.wavelengths,
        )
    elif kind == "EXR":
        frame, variances = session.frame(controls), scene.material.gaussians.variances
        write_exr(
            paths[0],
            frame,
            variances=variances.tolist() if len(frame.weights) == len(variances) else None,
            manifest={"scene": record} if record else None,
            camera=camera,
            wavelengths=scene.material.wavelengths,
        )
    elif kind == "material":
        save_material(
            scene.material,
            paths[0],
            profile=skin,
            source={"provenance": "the studio of splatjax"},
            g=controls.g,
        )
    else:
        if record:
            write_toml(paths[0], record)
        else:
            save_scene(paths[0], scene, camera, session.settings, g=controls.g)
        with atomic_path(paths[1]) as temporary:
            temporary.write_text(
                _PROGRAM.format(name=name, exposure=controls.exposure), encoding="utf-8"
            )
    return paths
