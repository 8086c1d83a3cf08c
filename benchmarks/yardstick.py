"""What we are measured by: programs of the shared prototype in C, on one thread, compiled here and
run in turns with ours.
"""

import importlib.util
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np

_COLUMNS = ("p", "n", "r", "col", "irr", "area")


def shared() -> Path:
    """Give the shared folder, or say what is missing and leave."""
    folder = os.environ.get("SPLATJAX_SHARED")
    if not folder:
        raise SystemExit(
            "SPLATJAX_SHARED is not set: it names the folder with prototype/scene.py, the "
            "benchmark's scene"
        )
    scene = Path(folder) / "prototype" / "scene.py"
    if not scene.is_file():
        raise SystemExit(f"{scene} is missing: without the scene there is nothing to measure")
    return Path(folder).resolve()


def make_scene(splats: int) -> dict[str, np.ndarray]:
    """Give the prototype's head: p, n, r, col, area, irr; mm, float32, in Morton order."""
    spec = importlib.util.spec_from_file_location(
        "prototype_scene", shared() / "prototype" / "scene.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make(splats)


class Native:
    """A program of the prototype; `build` gives none where it does not compile."""

    def __init__(self, program: Path, splats: int, width: int):
        self.program, self.splats, self.width = program, splats, width

    @classmethod
    def build(
        cls, folder: Path, name: str, data: dict[str, np.ndarray], width: int
    ) -> "Native | None":
        source, compiler = (
            shared() / "prototype" / f"{name}.c",
            shutil.which("gcc") or shutil.which("cc"),
        )
        if compiler is None or not source.is_file():
            missing = "no C compiler (gcc or cc)" if compiler is None else f"{source} is missing"
            print(f"No {source.name}: {missing}.")
            return None
        command = [
            compiler,
            "-O3",
            "-march=native",
            "-ffast-math",
            "-o",
            str(folder / name),
            str(source),
            "-lm",
        ]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        if built.returncode:
            print(f"No {source.name}: it does not compile on this machine.\n{built.stderr[-300:]}")
            return None
        columns = [np.asarray(data[name]).reshape(len(data["p"]), -1) for name in _COLUMNS]
        np.concatenate(columns, axis=1).astype(np.float32).tofile(
            folder / f"scene_{len(data['p'])}.bin"
        )
        return cls(folder / name, len(data["p"]), width)

    def once(self) -> dict[str, float]:
        """Run once (after two runs to warm up), and give what the program reports, in
        milliseconds.
        """
        command = [str(self.program), str(self.splats), str(self.width), "1"]
        found = subprocess.run(
            command, cwd=self.program.parent, capture_output=True, text=True, check=True
        )
        return json.loads(found.stdout.splitlines()[0])


class Yardstick:
    """Passes 2 and 3 in plain scalar C, the unit of all ratios, and what a hand-tuned program makes
    of them, if it compiles.
    """

    def __init__(self, folder: Path, data: dict[str, np.ndarray], width: int):
        self.plain, self.tuned = (
            Native.build(folder, name, data, width) for name in ("yard", "limit")
        )
        self.times: dict[str, list[float]] = {
            "yardstick": [],
            "limit": [],
            "limit with gradients": [],
        }

    def run(self) -> None:
        """Time both once."""
        if self.plain is not None:
            report = self.plain.once()
            self.times["yardstick"].append(report["setup"] + report["p2"] + report["p3"])
        if self.tuned is not None:
            report = self.tuned.once()
            self.times["limit"].append(report["fwd"])
            self.times["limit with gradients"].append(report["fwd"] + report["bwd"])

    def medians(self) -> dict[str, float | None]:
        """Give milliseconds by name; none of what did not compile."""
        return {name: float(np.median(each)) if each else None for name, each in self.times.items()}
