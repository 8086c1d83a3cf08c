"""What a studio writes: files under names of its own, in one folder."""

from collections.abc import Mapping
from pathlib import Path

from splatjax.io import atomic_path, save_material, write_exr, write_png

from ._controls import Controls
from ._session import Session

# By what is written.
SUFFIXES = {"TOML": [".toml"], "PNG": [".png"], "EXR": [".exr"], "Python": [".toml", ".py"]}
_PROGRAM = '''"""Render {name}.png of the material in {name}.toml, beside this file."""

from pathlib import Path

import splatjax as sj
from splatjax.studio import turned

sj.cache.keep()
here = Path(__file__).parent
splats = {splats}
lights = turned({lights}, {turn})
material = sj.load_material(here / "{name}.toml")
camera = sj.Camera.look_at({eye}, {target}, fov={fov}, width={width}, height={height})
frame = sj.render(sj.Scene(splats, lights, material), camera)
sj.write_png(here / "{name}.png", frame, exposure={exposure})
'''


def save(
    session: Session, controls: Controls, folder: Path, recipe: Mapping[str, str], kind: str
) -> list[Path]:
    """Write the material (TOML), the picture (PNG), all its layers (EXR), or the program that makes
    the picture, with the material (Python); under the next number that is free.

    **Arguments:**

    - `recipe`: expressions of Python that make the `splats` of the session, and its `lights` before
      they are turned; `sj` is splatjax.

    **Returns:** the paths of the files.

    **Raises:** `KeyError` for anything else, `OSError` where files cannot be written.
    """
    session.picture(controls)  # whose variances and angles are those of the coefficients
    material, camera = session.scene(controls).material, session.camera(controls)
    taken = {path.stem for path in folder.iterdir()}
    name = next(name for n in range(len(taken) + 1) if (name := f"studio_{n:03}") not in taken)
    size = {"fov": session.fov, "width": camera.width, "height": camera.height}
    program = _PROGRAM.format(name=name, **vars(controls), **size, **recipe)
    paths = [folder / f"{name}{suffix}" for suffix in SUFFIXES[kind]]
    if kind == "PNG":
        write_png(paths[0], session.frame(controls), exposure=controls.exposure)
    elif kind == "EXR":
        variances = material.gaussians.variances.tolist()
        manifest = {"program": program}
        write_exr(paths[0], session.frame(controls), variances=variances, manifest=manifest)
    else:
        source = {"provenance": "made in the studio of splatjax"}
        save_material(material, paths[0], source=source)
        for path in paths[1:]:
            with atomic_path(path) as temporary:
                temporary.write_text(program, encoding="utf-8")
    return paths
