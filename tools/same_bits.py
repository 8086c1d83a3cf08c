"""Does the same input give the same bits? `python tools/same_bits.py [runs]`.

Each kind of output is made in as many processes, by turns on one processor and on all that there
are, and their digests are compared. `--once picture` prints that of a picture alone.
"""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.geometry import complete_splats

RUNS = 10
OUTPUTS = ("bust", "points", "fit", "picture", "gradients", "files")


def outputs(names: Sequence[str] = OUTPUTS) -> dict[str, str]:
    """Return digests of small outputs: splats of the bust and of raw points, a fit, a picture with
    its gradients, files.
    """
    splats, material = sj.bust(3000), sj.load_material("skin").white()
    light = sj.DirectionalLight(jnp.asarray([0.3, -0.5, -0.8]), jnp.full(3, 3.0))
    camera = sj.Camera.look_at(jnp.asarray([0.0, 0.0, 700.0]), jnp.zeros(3), width=64, height=64)
    scene = sj.Scene(splats, (light,), material)
    plan = sj.make_plan(scene, camera)

    def picture(scene=scene):
        return eqx.filter_jit(sj.render)(scene, camera, plan=plan)

    def gradients():
        return eqx.filter_grad(lambda scene: (picture(scene).beauty ** 2).mean())(scene)

    def files():
        with tempfile.TemporaryDirectory() as folder:
            paths = Path(folder) / "a.exr", Path(folder) / "a.png"
            for path, write in zip(paths, (sj.write_exr, sj.write_png), strict=True):
                write(path, picture())
            return [np.frombuffer(path.read_bytes(), np.uint8) for path in paths]

    make = {
        "bust": lambda: splats,
        "points": lambda: complete_splats(np.asarray(splats.centers, np.float64)),
        "fit": lambda: sj.fit_gaussians(sj.Dipole(sj.load_medium("marble")), count=2).gaussians,
        "picture": picture,
        "gradients": gradients,
        "files": files,
    }
    leaves = {name: [np.asarray(leaf) for leaf in jax.tree.leaves(make[name]())] for name in names}
    return {
        name: hashlib.sha256(b"".join(leaf.tobytes() for leaf in arrays)).hexdigest()[:16]
        for name, arrays in leaves.items()
    }


def in_a_process(processors: set[int], *names: str) -> dict[str, str]:
    """Return digests from a process of its own, on some of the machine's processors."""
    words = ["taskset", "-c", ",".join(map(str, sorted(processors))), sys.executable, __file__]
    command = [*words, "--once", *(names or OUTPUTS)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return json.loads(printed.splitlines()[-1])


def main() -> None:
    """Compare runs, or be one."""
    if sys.argv[1:2] == ["--once"]:
        print(json.dumps(outputs(sys.argv[2:])))
        return
    everyone = os.sched_getaffinity(0)
    choices = {min(everyone)}, everyone
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    digests = [in_a_process(choices[i % 2]) for i in range(runs)]
    for name in OUTPUTS:
        print(f"{name}: {len({each[name] for each in digests})} different of {runs}")
    sys.exit(any(each != digests[0] for each in digests))


if __name__ == "__main__":
    main()
