"""Write the table of docs/which_profile.md, by Monte Carlo: `python tools/make_which_profile.py
[photons]`.

Half spaces of three indices, one walk each for all albedos; slabs from half a mean free path to
eight; three layers of skin.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj

PHOTONS = 2_000_000
PAGE = Path(__file__).parents[1] / "docs" / "which_profile.md"
BEGIN, END = "<!-- table: tools/make_which_profile.py -->", "<!-- end of table -->"
ALBEDOS = np.array([0.5, 0.8, 0.95, 0.99, 0.998, 0.9998])
INDICES = (1.0, 1.3, 1.5)
THICKNESSES = (0.5, 1.0, 2.0, 4.0, 8.0)
PLACES = (0.25, 1.0, 4.0, 16.0)  # mean free paths, at which model over truth is given

RINGS = np.concatenate([[0.0], np.geomspace(0.1, 60.0, 65)])
TITLES = ["medium", "true total", "model", "total off by", "E beyond 1"]
TITLES += [f"at {place:g}" for place in PLACES]
KEY = jax.random.key(2010)


def burley(medium: sj.Medium) -> sj.scattering.Burley:
    """Return Burley's curve with the better dipole's color; its length is the mean free path."""
    return sj.scattering.Burley(
        sj.scattering.BetterDipole(medium).total_reflectance(), 1 / medium.sigma_t_prime
    )


HALF_SPACES = {
    "Dipole": sj.Dipole,
    "BetterDipole": sj.scattering.BetterDipole,
    "PhotonBeam": sj.scattering.PhotonBeam,
    "Burley": burley,
}


def half_spaces(photons: int) -> Iterator[str]:
    """Rows of half spaces, by index and albedo. Lengths are mean free paths."""
    for number, eta in enumerate(INDICES):
        medium = sj.Medium(jnp.asarray(1 - ALBEDOS), jnp.asarray(ALBEDOS), jnp.full(6, eta))
        truth = walk([sj.Layer(medium, jnp.asarray(jnp.inf))], photons, number)
        models = {name: make(medium) for name, make in HALF_SPACES.items()}
        for channel, albedo in enumerate(ALBEDOS):
            yield from rows(f"half space, albedo' {albedo:g}, eta {eta:g}", truth, models, channel)


def slabs(photons: int) -> Iterator[str]:
    """Rows of slabs: reflectance and transmittance."""
    medium = sj.Medium(jnp.asarray([0.01]), jnp.asarray([0.99]), jnp.asarray([1.4]))
    for number, thickness in enumerate(THICKNESSES):
        layer = sj.Layer(medium, jnp.asarray(thickness))
        truth = walk([layer], photons, 10 + number)
        name = f"slab of {thickness:g}, albedo' 0.99, eta 1.4"
        if thickness < 1:
            total = f"{float(truth.total_reflectance.value[0]):.4f}"
            yield row(name, total, "Multipole", "refused", "", *[""] * len(PLACES))
            continue
        slab = sj.scattering.Multipole(layer)
        yield from rows(f"{name}, reflected", truth, {"Multipole": slab}, 0)
        below = {"Multipole": sj.scattering.Transmitted(slab)}
        yield from rows(f"{name}, transmitted", truth, below, 0, below=True)


def layers(photons: int) -> Iterator[str]:
    """Rows of the layered skin that is shipped."""
    skin = sj.load_profile("skin_layers")
    truth = walk(skin.layers, photons, 20)
    for channel, name in enumerate(("red", "green", "blue")):
        yield from rows(f"skin_layers, {name}", truth, {"LayeredMultipole": skin}, channel)


def walk(stack, photons: int, number: int) -> sj.transport.MonteCarlo:
    """Walk in float32, whatever the precision of the models."""
    stack = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), list(stack))
    key, edges = jax.random.fold_in(KEY, number), jnp.asarray(RINGS, jnp.float32)
    return sj.transport.monte_carlo(stack, photons, key, edges=edges, progress=report)


def report(done: int, photons: int) -> None:
    print(f"\r{done / photons:6.1%}", end="", file=sys.stderr, flush=True)


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def rows(
    name: str, truth: sj.transport.MonteCarlo, models: dict, channel: int, below: bool = False
) -> Iterator[str]:
    """Yield a row for each model: how far off its total is, Eq. 4 beyond one mean free path, and
    ratios by ring where the truth is known to 10%.
    """
    side = truth.transmitted if below else truth.reflected
    total = truth.total_transmittance if below else truth.total_reflectance
    values, errors = np.asarray(side.value)[:, channel], np.asarray(side.deviation)[:, channel]
    true_total = float(total.value[channel])
    for label, model in models.items():
        means = np.asarray(ring_means(model))[:, channel]
        length = float(model.length_scale()[channel]) if label == "LayeredMultipole" else 1.0
        far = (np.asarray(truth.radii, np.float64) > length) & (values > 0)
        weights = np.diff(RINGS**2)[far]
        # The square that the noise of the truth adds is subtracted.
        square = np.sum(weights * ((means - values) ** 2 - errors**2)[far])
        error = np.sqrt(max(square, 0.0) / np.sum(weights * values[far] ** 2))
        off = float(model.total_reflectance()[channel]) / true_total - 1
        rings = [np.searchsorted(RINGS, place * length) - 1 for place in PLACES]
        ratios = [
            f"{means[ring] / values[ring]:.2f}"
            if ring < len(values) and errors[ring] <= 0.1 * values[ring] > 0
            else ""
            for ring in rings
        ]
        first = (name, f"{true_total:.4f}") if model is next(iter(models.values())) else ("", "")
        yield row(*first, label, f"{off:+.1%}", f"{error:.3f}", *ratios)


def ring_means(model) -> jnp.ndarray:
    """Return the mean of a profile over each ring, by four Gauss-Legendre nodes in its radius."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    half, middle = np.diff(RINGS) / 2, (RINGS[1:] + RINGS[:-1]) / 2
    r = middle[:, None] + half[:, None] * nodes
    values = model(jnp.asarray(r.reshape(-1))).reshape(*r.shape, -1)
    shares = 2 * half[:, None] * weights * r / np.diff(RINGS**2)[:, None]
    return jnp.einsum("rn,rnc->rc", jnp.asarray(shares), values)


def main() -> None:
    photons = int(sys.argv[1]) if len(sys.argv) > 1 else PHOTONS
    lines = [row(*TITLES), row(*["---"] * len(TITLES))]
    with jax.enable_x64(True):
        lines += [line for part in (half_spaces, slabs, layers) for line in part(photons)]
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    table = "\n".join([BEGIN, *lines, END])
    PAGE.write_text(before + table + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
