"""The yardstick: passes 2 and 3 in scalar C on one thread, from the shared prototype, and the scene it draws."""

import importlib.util
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

FOCAL_LENGTH = 2.6  # in heights of the picture; the camera is at the origin and looks along +z
_COLUMNS = ("p", "n", "r", "col", "irr", "area")


def prototype() -> Path:
    """Give the folder of scene and yardstick, or say what is missing and leave."""
    shared = os.environ.get("SPLATJAX_SHARED")
    if not shared:
        raise SystemExit("SPLATJAX_SHARED is not set: it names the folder with prototype/scene.py, the benchmark's scene")
    folder = Path(shared) / "prototype"
    if not (folder / "scene.py").is_file():
        raise SystemExit(f"{folder / 'scene.py'} is missing: without the scene there is nothing to measure")
    return folder.resolve()


def make_scene(splats: int) -> dict[str, np.ndarray]:
    """Give the prototype's head: p, n, r, col, area, irr; mm, float32, in Morton order."""
    spec = importlib.util.spec_from_file_location("prototype_scene", prototype() / "scene.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make(splats)


class Yardstick:
    """Runs the C program; `build` gives none where there is no compiler."""

    def __init__(self, folder: Path, splats: int, width: int):
        self.folder, self.splats, self.width = folder, splats, width

    @classmethod
    def build(cls, folder: Path, scene: dict[str, np.ndarray], width: int) -> "Yardstick | None":
        source, compiler = prototype() / "yard.c", shutil.which("gcc") or shutil.which("cc")
        if compiler is None or not source.is_file():
            missing = "no C compiler (gcc or cc)" if compiler is None else f"{source} is missing"
            print(f"No yardstick: {missing}. Milliseconds are given without ratios.")
            return None
        command = [compiler, "-O3", "-march=native", "-ffast-math", "-o", str(folder / "yard"), str(source), "-lm"]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        if built.returncode:
            print(f"No yardstick: {source} does not compile. Milliseconds are given without ratios.\n{built.stderr[-500:]}")
            return None
        columns = [np.asarray(scene[name]).reshape(len(scene["p"]), -1) for name in _COLUMNS]
        np.concatenate(columns, axis=1).astype(np.float32).tofile(folder / f"scene_{len(scene['p'])}.bin")
        return cls(folder, len(scene["p"]), width)

    def milliseconds(self) -> float:
        """Time setup and passes 2 and 3 once (after two runs to warm up)."""
        command = [str(self.folder / "yard"), str(self.splats), str(self.width), "1"]
        report = json.loads(subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=True).stdout)
        return report["setup"] + report["p2"] + report["p3"]
