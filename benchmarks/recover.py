"""How well materials come back from one picture of the head: `python -m benchmarks.recover`. Needs
SPLATJAX_SHARED.

For each material: its picture is rendered, and its coefficients are searched from starts that are a
factor off. The picture is made by the same path, with six Gaussians and layers as fine; or by
another, with twice the splats, eight Gaussians and no clusters, or by the plain one that bins
nothing either. Then it gets noise, and the steps of the search are timed.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser, DenseDiffuser
from splatjax.splatting import DenseRasterizer

from .scenes import BODIES, columns, lit

COMPILED = "/jax/core/compile/backend_compile_duration"
WEIGHTS = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
FINE = sj.RenderSettings(diffuser=ClusterDiffuser(error=2.5e-4))
"""The default of `recover`."""
GOAL = 6.0  # forward frames for a step, all that a search does counted
OTHERWISE = {
    "unmerged": sj.RenderSettings(diffuser=ClusterDiffuser(error=0.0)),
    "plain": sj.RenderSettings(rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()),
}
LIGHTS = {"front": (0.5, 0.6, 0.65), "side": (-1.0, 0.15, 0.25), "behind": (0.6, 0.3, -0.8)}


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recover", description=__doc__)
    parser.add_argument("--body", choices=BODIES, default="synthetic", help="(default %(default)s)")
    parser.add_argument(
        "--splats", type=int, default=100_000, help="on the prototype's head (default %(default)s)"
    )
    parser.add_argument(
        "--width", type=int, default=256, help="of the square picture, pixels (default %(default)s)"
    )
    parser.add_argument("--materials", nargs="+", default=["marble", "skin1", "wholemilk"])
    parser.add_argument(
        "--lights",
        nargs="+",
        default=["side"],
        choices=LIGHTS,
        help="one picture for each (default %(default)s)",
    )
    parser.add_argument(
        "--off", type=float, default=3.0, help="factor of the starts (default %(default)s)"
    )
    parser.add_argument("--draws", type=int, default=20, help="of noise (default %(default)s)")
    parser.add_argument(
        "--noise",
        type=float,
        default=0.01,
        help="over a picture's root mean square (default %(default)s)",
    )
    parser.add_argument(
        "--otherwise",
        nargs="*",
        default=["unmerged"],
        choices=OTHERWISE,
        help="other paths (default %(default)s)",
    )
    return parser.parse_args()


def white(body: str, splats: int, width: int) -> tuple[sj.Splats, sj.Camera]:
    scene, camera = lit(columns(body, splats), width)
    return eqx.tree_at(
        lambda s: s.albedo, scene.splats, None, is_leaf=lambda leaf: leaf is None
    ), camera


def rendered(
    splats, camera, lights, medium: sj.Medium, count: int, settings: sj.RenderSettings | None = None
):
    gaussians = sj.fit_gaussians(sj.Dipole(medium), count, weights=WEIGHTS).gaussians
    material = sj.Material(gaussians, eta=medium.eta[0], specular=0.0)
    return [
        np.asarray(sj.render(sj.Scene(splats, (light,), material), camera, settings).beauty)
        for light in lights
    ]


def frame_seconds(
    splats, camera, light, medium: sj.Medium, settings: sj.RenderSettings | None = None
) -> float:
    """Time a forward frame of six layers, warm: the median of seven."""
    material = sj.Material(
        sj.fit_gaussians(sj.Dipole(medium), 6, weights=WEIGHTS).gaussians,
        eta=medium.eta[0],
        specular=0.0,
    )
    scene, times = sj.Scene(splats, (light,), material), []
    plan = sj.make_plan(scene, camera, settings)
    for _ in range(8):
        begin = time.perf_counter()
        jax.block_until_ready(sj.render(scene, camera, settings, plan))
        times.append(time.perf_counter() - begin)
    return float(np.median(times[1:]))


def starts(medium: sj.Medium, off: float) -> list[sj.Medium]:
    return [
        sj.Medium(medium.sigma_a * a, medium.sigma_s_prime * s, medium.eta)
        for a, s in ((off, 1 / off), (1 / off, off))
    ]


class Compilations:
    """Counts what is compiled."""

    def __init__(self):
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event, duration, **_):
        self.count += event == COMPILED


def errors(recovery: sj.inverse.Recovery | sj.inverse.Estimate, medium: sj.Medium) -> np.ndarray:
    """Give what each coefficient is off, as a share: two rows of channels."""
    pairs = (
        (recovery.medium.sigma_a, medium.sigma_a),
        (recovery.medium.sigma_s_prime, medium.sigma_s_prime),
    )
    return np.stack([np.asarray(found) / np.asarray(true) - 1 for found, true in pairs])


def tell_pulls(name: str, pulls: np.ndarray) -> None:
    """Say how often the truth lay within error bars: [noise's or all, draws, coefficients,
    channels].
    """
    for title, each in zip(("of noise", "reported"), np.abs(pulls), strict=True):
        for reach in (1, 2):
            inside = np.sum(each <= reach, axis=0)
            print(
                f"{name}: of {len(each)} draws, within {reach} error bars {title}: sigma_a "
                f"{inside[0]}, sigma_s' {inside[1]}; of "
                f"all {100 * np.mean(each <= reach):.0f}% (normal errors: {(68, 95)[reach - 1]}%)"
            )
        print(
            f"{name}: root mean square of errors over bars {title} {np.sqrt(np.mean(each**2)):.2f}",
            flush=True,
        )


def main() -> None:
    options = arguments()
    compiled, rows = Compilations(), []
    splats, camera = white(options.body, options.splats, options.width)
    lights = [
        sj.DirectionalLight(jnp.asarray(LIGHTS[name]), jnp.full(3, jnp.pi))
        for name in options.lights
    ]

    def recover(pictures, begin, deviations=None):
        deviations = deviations or [None] * len(pictures)
        together = zip(pictures, lights, deviations, strict=True)
        observations = [
            sj.inverse.Observation(picture, camera, (light,), deviation=sd)
            for picture, light, sd in together
        ]
        before, start = compiled.count, time.perf_counter()
        found = sj.inverse.recover(observations, splats, begin, model=sj.fitting.DiffusionModel())
        return found, time.perf_counter() - start, compiled.count - before

    def report(name, case, found, seconds, programs, medium):
        off, bars = errors(found, medium), np.stack(found.relative_errors())
        a, s = (
            ", ".join(
                f"{100 * each:+.2f} +- {100 * bar:.2f}" for each, bar in zip(*rows, strict=True)
            )
            for rows in zip(off, bars, strict=True)
        )
        ends = ", ".join(f"{cost:.3g}" for cost in found.costs)
        print(
            f"{name}, {case}: sigma_a off by {a}%, sigma_s' by {s}%; {found.rounds} rounds, "
            f"{found.steps} steps, "
            f"{seconds:.1f} s, {programs} programs compiled; the first round ends at losses of "
            f"{ends}; light that the splats do "
            f"not carry: {', '.join(f'{100 * float(each):.0f}%' for each in found.unresolved)}",
            flush=True,
        )
        rows.append(
            {
                "material": name,
                "case": case,
                "lights": options.lights,
                "splats": options.splats,
                "width": options.width,
                "errors": off.tolist(),
                "bars": bars.tolist(),
                "unresolved": np.asarray(found.unresolved).tolist(),
                "steps": found.steps,
                "rounds": found.rounds,
                "seconds": seconds,
                "programs": programs,
            }
        )

    with jax.enable_x64(True):
        for name in options.materials:
            medium = sj.load_medium(name)
            pictures = rendered(splats, camera, lights, medium, 6, FINE)
            begin = starts(medium, options.off)
            found, *cost = recover(pictures, begin)
            report(name, "same path", found, *cost, medium)
            for path in options.otherwise:
                others, _ = white(options.body, 2 * options.splats, options.width)
                seen = rendered(others, camera, lights, medium, 8, OTHERWISE[path])
                found, *cost = recover(seen, begin)
                report(name, f"{path}, twice the splats, eight Gaussians", found, *cost, medium)
            rng, pulls, seconds, programs, steps = np.random.default_rng(0), [], [], [], []
            for draw in range(options.draws):
                sizes = [options.noise * np.sqrt(np.mean(picture**2)) for picture in pictures]
                noisy = [
                    picture + sd * rng.normal(size=picture.shape)
                    for picture, sd in zip(pictures, sizes, strict=True)
                ]
                found, *cost = recover(
                    noisy,
                    begin,
                    [np.full(p.shape, sd) for p, sd in zip(pictures, sizes, strict=True)],
                )
                seconds.append(cost[0])
                programs.append(cost[1])
                steps.append(found.steps)
                off = np.log1p(errors(found, medium))
                pulls.append(
                    np.stack(
                        [
                            off / np.stack(found.noise_errors()),
                            off / np.stack(found.relative_errors()),
                        ]
                    )
                )
                pull = np.array2string(pulls[-1][0], precision=1, separator=" ").replace("\n", "")
                print(
                    f"{name}, draw {draw + 1}: {cost[0]:.1f} s, {cost[1]} programs; off by "
                    f"deviations {pull}",
                    flush=True,
                )
            if pulls:
                print(found.summary())
                print(f"chi-squared {float(found.chi_squared):.4f}")
                pulls = np.stack(pulls, axis=1)
                rows.append(
                    {
                        "material": name,
                        "case": "noise",
                        "noise": options.noise,
                        "pulls": pulls.tolist(),
                    }
                )
                tell_pulls(name, pulls)
                coarse, fine = (
                    frame_seconds(splats, camera, lights[0], medium, each) for each in (None, FINE)
                )
                each = np.asarray(seconds[1:] or seconds) / np.asarray(steps[1:] or steps)
                step = float(np.median(each))
                print(
                    f"a draw takes {np.median(seconds):.1f} s, the fastest {np.min(seconds):.1f} "
                    f"s; compiled {programs}\n"
                    f"a forward frame {coarse:.2f} s, with layers as fine as the search's "
                    f"{fine:.2f} s; a step, all of a "
                    f"draw over its steps, {step:.2f} s: {step / coarse:.1f} frames, or "
                    f"{step / fine:.1f} fine ones "
                    f"(goal {GOAL:.0f})",
                    flush=True,
                )
                rows.append(
                    {
                        "material": name,
                        "case": "step",
                        "frame": coarse,
                        "fine_frame": fine,
                        "step": step,
                    }
                )
    out = Path("out/recover.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"written: {out}")


if __name__ == "__main__":
    main()
