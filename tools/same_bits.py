"""Does the same input give the same bits? `python tools/same_bits.py [runs]`.

In as many processes, by turns on one processor and on all that there are, each kind of output is
made anew, and their digests are compared. `--once 0,1 picture` prints that of a picture made on
processors 0 and 1.
"""

import functools
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

RUNS = 10


def digest(*arrays) -> str:
    """Give a digest of arrays, bit by bit."""
    import numpy as np

    return hashlib.sha256(
        b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    ).hexdigest()[:16]


def outputs(
    names: Sequence[str] = ("bust", "points", "fit", "picture", "gradients", "files"),
) -> dict[str, str]:
    """Make a small one of everything: splats of the bust and of raw points, a fit, a picture with
    its gradients, files.
    """
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    import splatjax as sj
    from splatjax.geometry import complete_splats

    splats, material = sj.bust(3000), sj.load_material("skin").white()
    light = sj.DirectionalLight(jnp.asarray([0.3, -0.5, -0.8]), jnp.full(3, 3.0))
    camera = sj.Camera.look_at(jnp.asarray([0.0, 0.0, 700.0]), jnp.zeros(3), width=64, height=64)
    scene = sj.Scene(splats, (light,), material)

    @functools.cache
    def plan():
        return sj.plan(scene, camera)

    @functools.cache
    def frame():
        return eqx.filter_jit(sj.render)(scene, camera, plan=plan())

    def gradients():
        loss = eqx.filter_grad(
            lambda scene: (sj.render(scene, camera, plan=plan()).beauty ** 2).mean()
        )
        return eqx.filter_jit(loss)(scene)

    def files():
        with tempfile.TemporaryDirectory() as folder:
            paths = Path(folder) / "a.exr", Path(folder) / "a.png"
            sj.write_exr(paths[0], frame())
            sj.write_png(paths[1], frame())
            return [np.frombuffer(path.read_bytes(), np.uint8) for path in paths]

    make = {
        "bust": lambda: splats,
        "points": lambda: complete_splats(np.asarray(splats.centers, np.float64)),
        "fit": lambda: sj.fit_gaussians(sj.Dipole(sj.load_medium("marble")), count=2).gaussians,
        "picture": frame,
        "gradients": gradients,
        "files": files,
    }
    return {name: digest(*jax.tree.leaves(make[name]())) for name in names}


def in_a_process(processors: set[int], *names: str) -> dict[str, str]:
    """Make some, or everything, in a process of its own, on some of the machine's processors."""
    words = [sys.executable, __file__, "--once", ",".join(map(str, sorted(processors))), *names]
    return json.loads(
        subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()[-1]
    )


def main() -> None:
    """Compare runs, or be one."""
    if sys.argv[1:2] == ["--once"]:
        os.sched_setaffinity(
            0, {int(each) for each in sys.argv[2].split(",")}
        )  # before XLA counts them
        print(json.dumps(outputs(*[sys.argv[3:]] if sys.argv[3:] else [])))
        return
    everyone = os.sched_getaffinity(0)
    choices = {min(everyone)}, everyone
    found = [
        in_a_process(choices[i % 2]) for i in range(int(sys.argv[1]) if len(sys.argv) > 1 else RUNS)
    ]
    for name in found[0]:
        print(f"{name}: {len({each[name] for each in found})} different of {len(found)}")
    sys.exit(any(each != found[0] for each in found))


if __name__ == "__main__":
    main()
