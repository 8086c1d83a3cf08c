"""The same splats by PyTorch3D, where a person has it: `python -m benchmarks.peers`.

Pulsar blends spheres of the splats' radii and colors by depth, with no normals, no attributes and
no light: less than passes 2 and 3 do here. `PointsRasterizer` lists the nearest points of every
pixel and blends nothing; on a CPU it tries every point in every pixel, so it gets fewer splats and
pixels. Both are differentiable. Beside each time is how much of the picture is covered: about
the same, or it is not the same picture.
"""

import argparse
import time

import jax
import numpy as np

import splatjax as sj

from .frame import rasterization
from .scenes import BODIES, FOCAL_LENGTH, columns, lit

try:
    import torch
    from pytorch3d.renderer.points.pulsar import Renderer
    from pytorch3d.renderer.points.rasterize_points import rasterize_points
    from pytorch3d.structures import Pointclouds
except ImportError as missing:
    raise SystemExit(
        f"PyTorch3D cannot be imported ({missing}); install it, with PyTorch, to compare with it"
    ) from None

_GAMMA = 1e-3  # of Pulsar: how far depths blend; small means the nearest wins
_NEAREST = 8  # points listed for a pixel


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--body", choices=BODIES, default="synthetic", help="(default %(default)s)")
    parser.add_argument("--splats", type=int, default=683_549, help="(default %(default)s)")
    parser.add_argument(
        "--width",
        type=int,
        default=1024,
        help="of the square picture, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--few", type=int, default=10_000, help="splats for PointsRasterizer (default %(default)s)"
    )
    parser.add_argument(
        "--narrow", type=int, default=128, help="its picture, pixels (default %(default)s)"
    )
    return parser.parse_args()


def report(name: str, run, coverage) -> None:
    """Run twice, and time the second: the first compiles, or finds its memory."""
    run()
    start = time.perf_counter()
    found = run()
    print(
        f"{name}: {1e3 * (time.perf_counter() - start):.0f} ms, {100 * coverage(found):.1f}% "
        "covered",
        flush=True,
    )


def splatjax(data: dict[str, np.ndarray], width: int) -> None:
    scene, camera = lit(data, width)
    plan = sj.make_plan(scene, camera)
    forward, _, inputs = rasterization(scene, camera, plan, sj.RenderSettings())
    compiled = jax.jit(forward).lower(*inputs).compile()
    report(
        f"splatjax, passes 2+3 with normals and albedo, {len(data['p'])} splats at {width}^2",
        lambda: jax.block_until_ready(compiled(*inputs)),
        lambda found: np.mean(np.asarray(found[-1]) > 0.5),
    )


def pulsar(data: dict[str, np.ndarray], width: int) -> None:
    count = len(data["p"])
    renderer = Renderer(width, width, count)
    camera = torch.tensor(
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, FOCAL_LENGTH, 1.0]
    )  # position, rotation, focal length, sensor's width
    spheres = [torch.from_numpy(data[name]) for name in ("p", "col", "r")]
    farthest = float(data["p"][:, 2].max()) + 10
    report(
        f"Pulsar, colors, {count} spheres at {width}^2",
        lambda: renderer(*spheres, camera, _GAMMA, farthest),
        lambda picture: (picture.sum(dim=-1) > 0).float().mean().item(),
    )


def points(data: dict[str, np.ndarray], width: int) -> None:
    scale = 2 * FOCAL_LENGTH / data["p"][:, 2:]
    places = np.concatenate(
        [data["p"][:, :2] * -scale, data["p"][:, 2:]], axis=1
    )  # x to the left, y up, edges at 1
    cloud = Pointclouds([torch.from_numpy(places)])
    radii = torch.from_numpy(data["r"] * scale[:, 0])
    report(
        f"PointsRasterizer, {_NEAREST} nearest of each pixel, {len(places)} points at {width}^2",
        lambda: rasterize_points(cloud, width, radii, _NEAREST),
        lambda found: (found[0][..., 0] >= 0).float().mean().item(),
    )


def main() -> None:
    options = arguments()
    print(f"PyTorch on {torch.get_num_threads()} threads")
    many, few = (columns(options.body, count) for count in (options.splats, options.few))
    splatjax(many, options.width)
    pulsar(many, options.width)
    splatjax(few, options.narrow)
    points(few, options.narrow)


if __name__ == "__main__":
    main()
