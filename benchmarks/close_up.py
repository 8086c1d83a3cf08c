"""What a picture of a whole head does not fix, and what a close one does: `python -m
benchmarks.close_up`. Needs SPLATJAX_SHARED.

The scanned head, pictures made otherwise than the recovery makes them: twice the splats, eight
Gaussians, no clusters. First one of the whole head under a lamp from the side; then one of a spot
on the cheek, from closer up, where the splats lie closer, under the lamp or under a laser dot: with
the first (cases 2 and 3), and alone (4 and 5).
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.geometry import Mesh, sample_mesh
from splatjax.io import read_textured_mesh

from .heads import before_the_camera
from .recover import LIGHTS, OTHERWISE, errors, rendered, starts
from .scenes import FOCAL_LENGTH
from .yardstick import shared

SPOT = (28.0, 10.0)
"""On the cheek, mm to the right and below the middle of the picture."""
REACH = 14.0  # mm around the spot where splats lie closer
FIELD = 16.0  # mm that the close picture shows
DOT = 0.25  # mm, standard deviation of the laser dot
HEAD, LAMP, LASER = "the head", "the spot under the lamp", "the spot under a laser dot"
CASES = ((HEAD,), (HEAD, LAMP), (HEAD, LASER), (LAMP,), (LASER,))


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.close_up", description=__doc__)
    parser.add_argument(
        "--splats", type=int, default=100_000, help="on the head (default %(default)s)"
    )
    parser.add_argument(
        "--close", type=int, default=100_000, help="around the spot (default %(default)s)"
    )
    parser.add_argument(
        "--width",
        type=int,
        default=256,
        help="of the square picture of the head, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--close-width", type=int, default=128, help="of those of the spot (default %(default)s)"
    )
    parser.add_argument("--materials", nargs="+", default=["skin1"])
    parser.add_argument(
        "--cases",
        nargs="+",
        type=int,
        default=range(1, 6),
        choices=range(1, 6),
        help="in the order above (default: all)",
    )
    parser.add_argument(
        "--off", type=float, default=3.0, help="factor of the starts (default %(default)s)"
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=0.01,
        help="over a picture's root mean square, printed (default %(default)s)",
    )
    parser.add_argument(
        "--otherwise",
        default="unmerged",
        choices=OTHERWISE,
        help="the data's path (default %(default)s)",
    )
    return parser.parse_args()


def head() -> Mesh:
    """Give the scanned head without its maps, before the camera."""
    path = shared() / "data" / "lee_perry_smith" / "LeePerrySmith.glb"
    return before_the_camera(
        read_textured_mesh(path, mm_per_unit=53, v_up=True, crop_min_y=-0.9)[0]
    )


def spot_of(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Give the place and normal of the head's front at the spot."""
    corners = mesh.corners()
    middles, facing = (
        corners.mean(axis=1),
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
    )
    aside = np.hypot(middles[:, 0] - SPOT[0], middles[:, 1] - SPOT[1])
    face = np.argmin(np.where((middles[:, 2] < np.median(middles[:, 2])), aside, np.inf))
    normal = facing[face] / np.linalg.norm(facing[face])
    return middles[face], -normal * np.sign(normal[2])


def body(mesh: Mesh, spot: np.ndarray, count: int, close: int) -> sj.Splats:
    """Cover the head, with splats of their own around the spot."""
    near = np.linalg.norm(mesh.corners().mean(axis=1) - spot, axis=1) < REACH
    pieces = [sample_mesh(mesh.select(~near), count), sample_mesh(mesh.select(near), close)]
    spacings = [float(np.sqrt(np.mean(piece.areas))) for piece in pieces]
    print(f"splats {spacings[0]:.2f} mm apart, around the spot {spacings[1]:.2f} mm", flush=True)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *pieces)


def cameras(
    spot: np.ndarray, normal: np.ndarray, width: int, close_width: int
) -> tuple[sj.Camera, sj.Camera]:
    """Give the camera that sees the head, and the one that sees the spot."""
    whole = sj.Camera(jnp.zeros(3), jnp.eye(3), jnp.asarray(FOCAL_LENGTH), width, width)
    away = 100.0
    fov = float(np.degrees(2 * np.arctan(0.5 * FIELD / away)))
    up = jnp.asarray([0.0, -1.0, 0.0])
    close = sj.Camera.look_at(
        jnp.asarray(spot + away * normal),
        jnp.asarray(spot),
        up=up,
        fov=fov,
        width=close_width,
        height=close_width,
    )
    return whole, close


def print_row(
    found: sj.inverse.Recovery | sj.inverse.Estimate,
    medium: sj.Medium,
    name: str,
    pictures: Sequence[str],
) -> dict:
    """Print what was found, and give it as a row."""
    off, bars = errors(found, medium), np.stack(found.relative_errors())
    for what, wrong, bar in zip(("sigma_a", "sigma_s'"), off, bars, strict=True):
        print(
            f"  {what} off by",
            ", ".join(f"{100 * w:+.1f} +- {100 * b:.1f}%" for w, b in zip(wrong, bar, strict=True)),
        )
    print(found.summary(), flush=True)
    return {
        "material": name,
        "pictures": list(pictures),
        "errors": off.tolist(),
        "bars": bars.tolist(),
    }


def main() -> None:
    options = arguments()
    mesh, rows = head(), []
    spot, normal = spot_of(mesh)
    ours, theirs = (
        body(mesh, spot, times * options.splats, times * options.close) for times in (1, 2)
    )
    whole, close = cameras(spot, normal, options.width, options.close_width)
    lamp = sj.DirectionalLight(jnp.asarray(LIGHTS["side"]), jnp.full(3, jnp.pi))
    dot = sj.GaussianBeam(
        jnp.asarray(spot + 50 * normal),
        jnp.asarray(-normal),
        jnp.full(3, jnp.pi),
        jnp.asarray(DOT**2),
    )
    cases = [CASES[number - 1] for number in options.cases]
    shots = {HEAD: (whole, lamp), LAMP: (close, lamp), LASER: (close, dot)}
    shots = {title: shot for title, shot in shots.items() if any(title in case for case in cases)}
    with jax.enable_x64(True):
        for name in options.materials:
            medium = sj.load_medium(name)
            seen = {}
            for title, (camera, light) in shots.items():
                (picture,) = rendered(
                    theirs, camera, [light], medium, 8, OTHERWISE[options.otherwise]
                )
                deviation = np.full(picture.shape, options.noise * np.sqrt(np.mean(picture**2)))
                seen[title] = sj.inverse.Observation(picture, camera, (light,), deviation=deviation)
                Path("out").mkdir(exist_ok=True)
                sj.write_png(
                    f"out/close_up_{name}_{title.replace(' ', '_')}.png",
                    picture / np.quantile(picture, 0.99),
                )
            apart = {}
            for case in cases:
                begin = time.perf_counter()
                found = sj.inverse.recover(
                    [seen[title] for title in case],
                    ours,
                    starts(medium, options.off),
                    model=sj.fitting.DiffusionModel(),
                )
                print(f"\n{name} from {' and '.join(case)}, {time.perf_counter() - begin:.0f} s:")
                rows.append(print_row(found, medium, name, case))
                if len(case) == 1:
                    apart[case[0]] = found
                Path("out/close_up.json").write_text(json.dumps(rows, indent=1) + "\n")
            if HEAD in apart and len(apart) > 1:
                closest = [title for title in (HEAD, LASER, LAMP) if title in apart][:2]
                print(f"\n{name} from {' and '.join(closest)}, each searched apart, combined:")
                rows.append(
                    print_row(
                        sj.inverse.combined([apart[title] for title in closest]),
                        medium,
                        name,
                        closest,
                    )
                )
                Path("out/close_up.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
