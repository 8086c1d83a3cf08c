"""Write the table of docs/which_profile.md anew, by Monte Carlo: `python
tools/make_which_profile.py [photons]`.

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
PLACES = (0.25, 1.0, 4.0, 16.0)
"""Mean free paths, at which model over truth is given."""

RINGS = np.concatenate([[0.0], np.geomspace(0.1, 60.0, 65)])
HEAD = (
    "| medium | true total | model | total off by | E beyond 1 | "
    + " | ".join(f"at {place:g}" for place in PLACES)
    + " |"
)
KEY = jax.random.key(2010)


def burley(medium: sj.Medium) -> sj.Burley:
    """Give Burley's curve with the better dipole's color; its length is the mean free path."""
    return sj.Burley(sj.BetterDipole(medium).total_reflectance(), 1 / medium.sigma_t_prime)


HALF_SPACES = {
    "Dipole": sj.Dipole,
    "BetterDipole": sj.BetterDipole,
    "PhotonBeam": sj.PhotonBeam,
    "Burley": burley,
}


def half_spaces(photons: int) -> Iterator[str]:
    """Rows of half spaces, by index and albedo. Lengths are mean free paths."""
    for number, eta in enumerate(INDICES):
        sigma_a, sigma_s_prime = jnp.asarray(1 - ALBEDOS), jnp.asarray(ALBEDOS)
        medium = sj.Medium(sigma_a, sigma_s_prime, jnp.full(len(ALBEDOS), eta))
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
            yield f"| {name} | {share(truth.total_reflectance)} | Multipole | refused |" + " |" * (
                1 + len(PLACES)
            )
            continue
        slab = sj.Multipole(layer)
        yield from rows(name + ", reflected", truth, {"Multipole": slab}, 0)
        yield from rows(
            name + ", transmitted", truth, {"Multipole": slab.transmitted()}, 0, below=True
        )


def layers(photons: int) -> Iterator[str]:
    """Rows of the layered skin that is shipped."""
    skin = sj.load_profile("skin_layers")
    truth = walk(skin.layers, photons, 20, unit=1.0)
    for channel, name in enumerate(("red", "green", "blue")):
        yield from rows(f"skin_layers, {name}", truth, {"LayeredMultipole": skin}, channel)


def walk(stack, photons: int, number: int, unit: float = 1.0) -> sj.MonteCarlo:
    """Walk in float32, whatever the precision of the models."""
    stack = jax.tree.map(lambda each: each.astype(jnp.float32), list(stack))
    key = jax.random.fold_in(KEY, number)
    return sj.monte_carlo(
        stack, photons, key, edges=jnp.asarray(RINGS * unit, jnp.float32), progress=tell
    )


def tell(done: int, photons: int) -> None:
    print(f"\r{done / photons:6.1%}", end="", file=sys.stderr, flush=True)


def rows(
    name: str, truth: sj.MonteCarlo, models: dict, channel: int, below: bool = False
) -> Iterator[str]:
    """A row for each model: how far off its total is, Eq. 4 beyond one mean free path, and ratios
    by ring.
    """
    side, total = (
        (truth.transmitted, truth.total_transmittance)
        if below
        else (truth.reflected, truth.total_reflectance)
    )
    values, errors = np.asarray(side.value)[:, channel], np.asarray(side.deviation)[:, channel]
    edges, radii = RINGS, np.asarray(truth.radii, np.float64)
    true = share(total, channel)
    for label, model in models.items():
        found = np.asarray(ring_means(model, edges))[:, channel]
        length = float(model.length_scale()[channel]) if label == "LayeredMultipole" else 1.0
        far = (radii > length) & (values > 0)
        weights = np.diff(edges**2)
        # What the noise of the truth adds to the square is taken off.
        square = np.sum(weights[far] * ((found - values) ** 2 - errors**2)[far])
        error = np.sqrt(max(square, 0.0) / np.sum(weights[far] * values[far] ** 2))
        off = float(model.total_reflectance()[channel]) / float(total.value[channel]) - 1
        ratios = [ratio(found, values, errors, edges, place * length) for place in PLACES]
        yield (
            f"| {name} | {true} | {label} | {off:+.1%} | {error:.3f} | " + " | ".join(ratios) + " |"
        )
        name = true = ""


def ring_means(model, edges: np.ndarray) -> jnp.ndarray:
    """Mean of a profile over each ring, four Gauss-Legendre nodes in its radius."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    half, middle = np.diff(edges) / 2, (edges[1:] + edges[:-1]) / 2
    r = middle[:, None] + half[:, None] * nodes
    values = model(jnp.asarray(r.reshape(-1))).reshape(*r.shape, -1)
    return jnp.einsum(
        "rn,rnc->rc",
        jnp.asarray(2 * half[:, None] * weights * r / np.diff(edges**2)[:, None]),
        values,
    )


def ratio(found, values, errors, edges, place: float) -> str:
    """Model over truth in the ring that holds a radius; nothing where the truth is known to less
    than 10%.
    """
    ring = np.searchsorted(edges, place) - 1
    if ring >= len(values) or errors[ring] > 0.1 * values[ring] or values[ring] == 0:
        return ""
    return f"{found[ring] / values[ring]:.2f}"


def share(total, channel: int = 0) -> str:
    return f"{float(total.value[channel]):.4f}"


def table(photons: int) -> str:
    """All rows."""
    lines = [HEAD, "|" + " --- |" * (HEAD.count("|") - 1)]
    for part in (half_spaces, slabs, layers):
        lines.extend(part(photons))
    return "\n".join(lines)


def main() -> None:
    photons = int(sys.argv[1]) if len(sys.argv) > 1 else PHOTONS
    with jax.enable_x64(True):
        written = table(photons)
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(f"{before}{BEGIN}\n{written}\n{END}{after}", encoding="utf-8")
    print(f"\nwritten: {PAGE}", file=sys.stderr)


if __name__ == "__main__":
    main()
