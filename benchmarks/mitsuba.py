"""What comes back from path-traced pictures, and what a differentiable path tracer takes: `python
-m benchmarks.mitsuba`.

A sphere with no change of index at its surface, lit from the side, is path-traced (Mitsuba 3,
`volpath`, each channel by itself). From its picture `recover` finds the coefficients by each model;
so it does from the picture that splatjax makes of a profile by Monte Carlo, whose error is the
model's alone. Then Mitsuba's `prbvolpath` walks down the same picture's squared error, by Adam,
from the same starts. Seconds are the processor's, of all threads, compiling included. Needs
`mitsuba` (the dependency group `truth`), and for it an LLVM newer than 15, which
`DRJIT_LIBLLVM_PATH` names where several are installed.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.geometry import Mesh, sample_mesh, vertex_normals

from .recover import WEIGHTS, errors, starts

RADIUS = 10.0  # mm
EYE, FOV = (0.0, 0.0, 80.0), 17.0
WAY = (-1.0, -1.0, -1.0)
IRRADIANCE = float(np.pi)
DEPTH = 4000  # of paths; Russian roulette from a tenth of it on
MODELS = {
    "transport": sj.fitting.TransportModel(),
    "dipole": sj.fitting.DiffusionModel(),
    "better dipole": sj.fitting.DiffusionModel(sj.scattering.BetterDipole),
}
PHOTONS = 300_000
RATE = 0.1  # Adam's, in logarithms of coefficients: from afar to nearly nothing by a cosine


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mitsuba", description=__doc__)
    parser.add_argument("--materials", nargs="+", default=["marble", "skin1"])
    parser.add_argument(
        "--models",
        nargs="*",
        default=list(MODELS),
        choices=MODELS,
        help="to recover by; none: the path tracer",
    )
    parser.add_argument(
        "--width", type=int, default=64, help="of the square picture, pixels (default %(default)s)"
    )
    parser.add_argument(
        "--samples",
        type=int,
        default=4096,
        help="paths per pixel of the truth (default %(default)s)",
    )
    parser.add_argument(
        "--splats", type=int, default=40_000, help="on the sphere (default %(default)s)"
    )
    parser.add_argument(
        "--off", type=float, default=3.0, help="factor of the starts (default %(default)s)"
    )
    parser.add_argument(
        "--steps", type=int, default=200, help="of the path tracer; 0: none (default %(default)s)"
    )
    parser.add_argument(
        "--step-samples",
        type=int,
        default=32,
        help="paths per pixel of its steps (default %(default)s)",
    )
    return parser.parse_args()


def path_tracer():
    """Give Mitsuba, or say what is missing and leave."""
    try:
        import mitsuba
    except ImportError:
        raise SystemExit(
            "mitsuba is not installed, and it makes the truth here: pip install mitsuba==3.9.1"
        ) from None
    mitsuba.set_variant("llvm_ad_mono")
    return mitsuba


class Traced:
    """The sphere of one channel's medium in Mitsuba."""

    def __init__(self, mi, width: int, sigma_a: float, sigma_s: float):
        self.mi = mi
        medium = {
            "type": "homogeneous",
            "sigma_t": sigma_a + sigma_s,
            "albedo": sigma_s / (sigma_a + sigma_s),
            "phase": {"type": "isotropic"},
        }
        film = {
            "type": "hdrfilm",
            "width": width,
            "height": width,
            "pixel_format": "luminance",
            "rfilter": {"type": "box"},
        }
        view = mi.ScalarTransform4f().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 1, 0])
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "body": {
                    "type": "sphere",
                    "radius": RADIUS,
                    "bsdf": {"type": "null"},
                    "interior": medium,
                },
                "light": {"type": "directional", "direction": list(WAY), "irradiance": IRRADIANCE},
                "camera": {
                    "type": "perspective",
                    "fov": FOV,
                    "fov_axis": "y",
                    "to_world": view,
                    "film": film,
                    "sampler": {"type": "independent"},
                },
            }
        )
        self.parameters = mi.traverse(self.scene)
        keys = self.parameters.keys()
        self.total, self.albedo = (
            next(key for key in keys if key.endswith(f"{name}.value.value"))
            for name in ("sigma_t", "albedo")
        )

    def integrator(self, kind: str):
        return self.mi.load_dict({"type": kind, "max_depth": DEPTH, "rr_depth": DEPTH // 10})

    def picture(self, samples: int, at_once: int = 256) -> tuple[np.ndarray, np.ndarray]:
        """Give the picture, and the variance of its noise."""
        integrator, passes = self.integrator("volpath"), max(2, samples // at_once)
        found = [
            np.asarray(
                self.mi.render(self.scene, integrator=integrator, spp=samples // passes, seed=i),
                float,
            )[..., 0]
            for i in range(passes)
        ]
        return np.mean(found, axis=0), np.var(found, axis=0, ddof=1) / passes

    def descend(
        self, truth: np.ndarray, start: tuple[float, float], steps: int, samples: int
    ) -> list[dict]:
        """Walk from a start down the squared error, by Adam; give where it was after each step, and
        when.
        """
        import drjit as dr

        mi, integrator = self.mi, self.integrator("prbvolpath")
        reference = mi.TensorXf(truth[..., None].astype(np.float32))
        unit = 1 / float(np.mean(truth**2))
        optimizer = mi.ad.Adam(lr=RATE)
        optimizer["a"], optimizer["s"] = mi.Float(np.log(start[0])), mi.Float(np.log(start[1]))
        path, begin = [], time.process_time()
        for step in range(steps):
            optimizer.set_learning_rate(
                RATE * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / steps)))
            )
            sigma_a, sigma_s = dr.exp(optimizer["a"]), dr.exp(optimizer["s"])
            self.parameters[self.total] = sigma_a + sigma_s
            self.parameters[self.albedo] = sigma_s / (sigma_a + sigma_s)
            self.parameters.update()
            made = mi.render(
                self.scene,
                self.parameters,
                integrator=integrator,
                spp=samples,
                spp_grad=samples,
                seed=2 * step,
                seed_grad=2 * step + 1,
            )
            loss = unit * dr.mean(dr.square(made - reference), axis=None)
            dr.backward(loss)
            optimizer.step()
            now = [float(np.exp(np.asarray(optimizer[name]).item())) for name in ("a", "s")]
            path.append(
                {"seconds": time.process_time() - begin, "sigma_a": now[0], "sigma_s_prime": now[1]}
            )
        return path


def sphere(count: int) -> sj.Splats:
    import trimesh

    ball = trimesh.creation.icosphere(6, RADIUS)
    vertices, faces = np.asarray(ball.vertices, float), np.asarray(ball.faces)
    return sample_mesh(Mesh(vertices, faces, vertex_normals(vertices, faces)), count)


def off(a: np.ndarray, b: np.ndarray) -> list[float]:
    """Give, per channel, the root mean square of a difference over that of the second picture,
    where both are known.
    """
    there = np.all(np.isfinite(a), axis=-1)
    return (np.sqrt(np.mean((a - b)[there] ** 2, axis=0) / np.mean(b[there] ** 2, axis=0))).tolist()


def percents(values) -> str:
    return ", ".join(f"{100 * each:+.1f}" for each in np.ravel(values))


class Splatted:
    """The sphere as splats, under the same light and camera."""

    def __init__(self, count: int, width: int):
        self.splats, self.light = (
            sphere(count),
            sj.DirectionalLight(jnp.asarray(WAY), jnp.full(3, IRRADIANCE)),
        )
        self.camera = sj.Camera.look_at(
            jnp.asarray(EYE), jnp.zeros(3), fov=FOV, width=width, height=width
        )

    def picture(self, profile, rule=None, angles=None) -> np.ndarray:
        more = {} if rule is None else {"rule": rule}
        gaussians = sj.fit_gaussians(profile, 6, weights=WEIGHTS, **more).gaussians
        material = sj.Material(gaussians, eta=1.0, specular=0.0, angles=angles)
        frame = sj.render(sj.Scene(self.splats, (self.light,), material), self.camera)
        filled = np.asarray(frame.coverage)[..., None] > 0.999
        return np.where(filled, np.asarray(frame.beauty, float), np.nan)

    def recover(
        self, picture: np.ndarray, medium: sj.Medium, model, away: float
    ) -> tuple[sj.inverse.Recovery, float]:
        seen, begin = (
            sj.inverse.Observation(picture, self.camera, (self.light,)),
            time.process_time(),
        )
        return sj.inverse.recover(
            [seen], self.splats, starts(medium, away), model=model
        ), time.process_time() - begin


def compared(mi, splatted: Splatted, name: str, options) -> dict:
    """Recover one material from pictures of both makes."""
    known = sj.load_medium(name)
    medium = sj.Medium(known.sigma_a, known.sigma_s_prime, jnp.ones(3))
    pairs = np.stack([np.asarray(medium.sigma_a), np.asarray(medium.sigma_s_prime)], axis=1)
    begin = time.process_time()
    traced = [Traced(mi, options.width, *pair) for pair in pairs]
    found = [each.picture(options.samples) for each in traced]
    truth, noise = (np.stack(each, axis=-1) for each in zip(*found, strict=True))
    seconds = time.process_time() - begin
    grain = np.sqrt(np.mean(noise, axis=(0, 1)) / np.mean(truth**2, axis=(0, 1)))
    print(
        f"\n{name}: path-traced in {seconds:.0f} s, noise {percents(grain)}% (red, green, blue)",
        flush=True,
    )
    row = {"material": name, "trace_seconds": seconds, "noise": grain.tolist(), "models": []}
    if options.models:
        row["models"] = recovered(splatted, medium, truth, options)
    if options.steps:
        row["descent"] = [
            [
                each.descend(
                    truth[..., c], (a * times, s / times), options.steps, options.step_samples
                )
                for times in (options.off, 1 / options.off)
            ]
            for c, (each, (a, s)) in enumerate(zip(traced, pairs, strict=True))
        ]
        tell_descent(row["descent"], pairs)
    return row


def recovered(splatted: Splatted, medium: sj.Medium, truth: np.ndarray, options) -> list[dict]:
    """Recover from the path-traced picture, and from that of a profile by Monte Carlo: what then is
    off is the model's fault.
    """
    chosen = {title: MODELS[title] for title in options.models}
    with jax.enable_x64(False):
        layer = sj.Layer(
            jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), float), medium),
            jnp.asarray(jnp.inf),
        )
        walks = sj.transport.monte_carlo([layer], PHOTONS, jax.random.key(4)).profile()
    rule = sj.scattering.L2_QUADRATURE.beyond(0.2 / float(np.max(medium.sigma_t_prime)))
    by_walks = splatted.picture(
        jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), float), walks), rule
    )
    made = {"Monte Carlo": by_walks} | {
        title: splatted.picture(model.profile(medium), model.rule, model.angles(medium))
        for title, model in chosen.items()
    }
    rows = []
    for title, picture in made.items():
        print(
            f"  the picture of the true coefficients, {title}: off by "
            f"{percents(off(picture, truth))}% rms",
            flush=True,
        )
    for title, model in chosen.items():
        for data, picture in (("path-traced", truth), ("of Monte Carlo's profile", by_walks)):
            recovery, took = splatted.recover(picture, medium, model, options.off)
            wrong = errors(recovery, medium)
            bars = np.stack(recovery.relative_errors())
            (left,) = recovery.residuals
            print(
                f"  {data}, {title}: sigma_a off by {percents(wrong[0])}% (bars "
                f"{percents(bars[0])}), sigma_s' by "
                f"{percents(wrong[1])}% (bars {percents(bars[1])}); leaves "
                f"{percents(off(picture + left, picture))}% rms; {took:.0f} s",
                flush=True,
            )
            rows.append(
                {
                    "data": data,
                    "model": title,
                    "errors": wrong.tolist(),
                    "bars": bars.tolist(),
                    "seconds": took,
                }
            )
    return rows


def tell_descent(descent: list[list[dict]], pairs: np.ndarray) -> None:
    """Say how long each channel took from each start to be within shares of the truth, and to stay
    there.
    """
    for reach in (0.2, 0.1, 0.05, 0.03):
        times = []
        for paths, (a, s) in zip(descent, pairs, strict=True):
            for path in paths:
                wrong = [
                    max(abs(at["sigma_a"] / a - 1), abs(at["sigma_s_prime"] / s - 1)) for at in path
                ]
                outside = [i for i, each in enumerate(wrong) if each > reach]
                last = outside[-1] + 1 if outside else 0
                times.append(f"{path[last]['seconds']:.0f} s" if last < len(path) else "never")
        print(
            f"  prbvolpath within {100 * reach:.0f}% (red, red, green, green, blue, blue from both "
            f"starts): {', '.join(times)}"
        )
    for c, paths in enumerate(descent):
        for path in paths:
            end = path[-1]
            wrong = percents(
                [end["sigma_a"] / pairs[c][0] - 1, end["sigma_s_prime"] / pairs[c][1] - 1]
            )
            print(
                f"  prbvolpath, channel {c}: ends off by {wrong}% after {end['seconds']:.0f} s and "
                f"{len(path)} steps",
                flush=True,
            )


def main() -> None:
    options = arguments()
    mi, rows = path_tracer(), []
    out = Path("out/mitsuba.json")
    out.parent.mkdir(exist_ok=True)
    with jax.enable_x64(True):
        splatted = Splatted(options.splats, options.width)
        for name in options.materials:
            rows.append(compared(mi, splatted, name, options))
            out.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"written: {out}")


if __name__ == "__main__":
    main()
