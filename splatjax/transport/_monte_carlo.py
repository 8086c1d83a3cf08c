"""Profiles by random walks: the truth that diffusion approximates."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key

from splatjax.scattering import Film, Layer, Tabulated

from ._incidence import AbstractIncidence, NormalIncidence
from ._phase import AbstractPhaseFunction, Isotropic
from ._rounds import Walk, finish, lanes_for
from ._stack import LayeredMedia, check_layers
from ._tally import Tally
from ._walk import Optics

_FLIGHTS = 20_000


class Estimate(eqx.Module):
    """A mean over photons and its standard error, of one shape."""

    value: Float[Array, "..."]
    deviation: Float[Array, "..."]


class MonteCarlo(eqx.Module):
    r"""What became of the light that entered, by counting photons.

    Powers are shares of what enters, as for every profile: what the surface reflects outright,
    `specular`, is a share of what arrives.

    **Attributes:**

    - `edges`: of the rings, mm.
    - `reflected`, `transmitted`: what leaves above and below through each ring, by its area;
      1/mm^2, [rings, channels].
    - `total_reflectance`, `total_transmittance`: all that leaves, wherever it does; [channels].
    - `absorbed`: in each layer; [layers, channels].
    - `unfinished`: what photons still carried after the last flight they were allowed; [channels].
    - `specular`: [channels].
    """

    edges: Float[Array, " edges"]
    reflected: Estimate
    transmitted: Estimate
    total_reflectance: Estimate
    total_transmittance: Estimate
    absorbed: Estimate
    unfinished: Estimate
    specular: Float[Array, " channels"]

    @property
    def radii(self) -> Float[Array, " rings"]:
        """The mean radius of each ring, mm: where a straight profile has its mean over the ring."""
        return _mean_radii(self.edges)

    def profile(self) -> Tabulated:
        """Give the reflectance as a profile; its total is that of all that leaves, farther out than
        the last ring too.
        """
        return Tabulated(
            self.radii, self.reflected.value, self.reflected.deviation, self.total_reflectance.value
        )

    def transmitted_profile(self) -> Tabulated:
        """Give the transmittance as a profile."""
        return Tabulated(
            self.radii,
            self.transmitted.value,
            self.transmitted.deviation,
            self.total_transmittance.value,
        )

    def balance(self) -> Float[Array, " channels"]:
        """Give all that is accounted for, less 1: rounding, and the chance by which faint photons
        are given up.
        """
        parts = (self.total_reflectance, self.total_transmittance, self.unfinished)
        return sum(part.value for part in parts) + jnp.sum(self.absorbed.value, axis=0) - 1


@jax.jit
def _mean_radii(edges: Float[Array, " edges"]) -> Float[Array, " rings"]:
    a, b = edges[:-1], edges[1:]
    return 2 / 3 * (a * a + a * b + b * b) / (a + b)


def monte_carlo(
    layers: Sequence[Layer | Film],
    photons: int,
    key: Key[Array, ""],
    *,
    edges: Float[Array, " edges"] | None = None,
    incidence: AbstractIncidence | None = None,
    phase: AbstractPhaseFunction | None = None,
    eta_above: Float[Array, " channels"] | float = 1.0,
    eta_below: Float[Array, " channels"] | float = 1.0,
    flights: int = _FLIGHTS,
    progress: Callable[[int, int], None] | None = None,
) -> MonteCarlo:
    r"""Walk photons through layers and count where they leave: no diffusion, no limit on thinness
    or absorption.

    Photons fly from scattering to scattering; absorption lessens what they carry; interfaces
    reflect or refract them by Fresnel's formulas. Channels that differ in absorption alone, or in
    scale alone (a half space of one index), share their walks: the flights are made once, and their
    errors go together.

    Differentiable in `sigma_a`, `sigma_s_prime` and the optical depth of films, in forward and
    reverse mode, by the likelihood of each path. The standard errors are constants; those of
    derivatives: `path_derivatives`.

    **Arguments:**

    - `layers`: from the top; only the lowest may be infinite.
    - `photons`: how many for each walk; errors fall with its root.
    - `key`: of `jax.random`; the same key gives the same numbers.
    - `edges`: of the rings, mm; ascending. By default 128 rings whose widths grow in proportion,
      from a fiftieth of a mean free path.
    - `incidence`: `NormalIncidence()` (default) or `DiffuseIncidence()`.
    - `phase`: `Isotropic()` (default) or `HenyeyGreenstein(g)`; `sigma_s = sigma_s' / (1 - g)`.
    - `eta_above`, `eta_below`: indices of the neighbors relative to air.
    - `flights`: from event to event, at most so many for each photon; what it then carries is
      `unfinished`.
    - `progress`: called from time to time with the photons done and all of them.

    **Returns:** a `MonteCarlo`.

    **Raises:** `ValueError` for no scattering layer, for an infinite layer above another, for a
    number of photons below 2 or not below 2^30, for edges that do not ascend, and for derivatives
    in other arguments.

    **Source:** Wang, Jacques and Zheng 1995 (MCML); one walk for many absorptions: Kienle and
    Patterson 1996; path weights: Hayakawa et al. 2001.
    """
    media, setup = _set_up(
        layers, photons, key, edges, incidence, phase, eta_above, eta_below, flights
    )
    return _monte_carlo(media, setup, progress=progress)


class PathDerivatives(eqx.Module):
    r"""Derivatives of what `monte_carlo` gives, with their standard errors.

    **Attributes:** (a leading axis runs over the layers with whose coefficient each channel is
    differentiated)

    - `reflected`, `transmitted`: 1/mm^2 by 1/mm, [layers, rings, channels].
    - `total_reflectance`, `total_transmittance`: [layers, channels].
    - `absorbed`: [layers, layers, channels].
    """

    reflected: Estimate
    transmitted: Estimate
    total_reflectance: Estimate
    total_transmittance: Estimate
    absorbed: Estimate
    unfinished: Estimate


def path_derivatives(
    layers: Sequence[Layer | Film],
    photons: int,
    key: Key[Array, ""],
    *,
    edges: Float[Array, " edges"] | None = None,
    incidence: AbstractIncidence | None = None,
    phase: AbstractPhaseFunction | None = None,
    eta_above: Float[Array, " channels"] | float = 1.0,
    eta_below: Float[Array, " channels"] | float = 1.0,
    flights: int = _FLIGHTS,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[MonteCarlo, PathDerivatives, PathDerivatives]:
    r"""Give what `monte_carlo` gives, and its derivatives in each layer's `sigma_a` and `sigma_s`
    (mm), with standard errors.

    **Arguments:** as for `monte_carlo`.

    **Returns:** the estimate, and its derivatives by absorption and by scattering. A film's
    absorption is its optical depth over its thickness, a millionth of a free path.
    """
    media, setup = _set_up(
        layers, photons, key, edges, incidence, phase, eta_above, eta_below, flights
    )
    return _walk_all(media, setup, with_derivatives=True, progress=progress)


class _Setup(eqx.Module):
    """What a walk needs beside media. The number of photons asks for no program of its own."""

    edges: Float[Array, " edges"]
    incidence: AbstractIncidence
    phase: AbstractPhaseFunction
    key: Key[Array, ""]
    photons: Int[Array, ""]
    flights: Int[Array, ""]
    lanes: int = eqx.field(static=True)


def _set_up(
    layers, photons, key, edges, incidence, phase, eta_above, eta_below, flights
) -> tuple[LayeredMedia, _Setup]:
    """Check and complete the arguments of `monte_carlo`."""
    for name, number, least in (("photons", photons, 2), ("flights", flights, 1)):
        if not least <= number < 2**30:
            raise ValueError(f"{name} must be at least {least}, and below 2^30; got {number}")
    check_layers(layers)
    phase = Isotropic() if phase is None else phase
    above, below = (
        eta if isinstance(eta, jax.Array) else jnp.asarray(eta, jnp.result_type(float))
        for eta in (eta_above, eta_below)
    )
    media, edges = _laid_out(tuple(layers), phase, above, below, edges)
    if not isinstance(edges, Tracer):
        known = np.asarray(edges)
        if len(known) < 2 or known[0] < 0 or np.any(np.diff(known) <= 0):
            raise ValueError(
                f"edges must ascend from at least 0 mm, two or more of them; got {known.tolist()}"
            )
    incidence = NormalIncidence() if incidence is None else incidence
    numbers = (jnp.asarray(each, jnp.int32) for each in (photons, flights))
    return media, _Setup(edges, incidence, phase, key, *numbers, lanes_for(photons))


@eqx.filter_jit
def _laid_out(
    layers: tuple[Layer | Film, ...], phase: AbstractPhaseFunction, eta_above, eta_below, edges
):
    """Give media, and rings in their precision."""
    dtype = next(each.medium.sigma_a.dtype for each in layers if isinstance(each, Layer))
    anisotropy = phase.anisotropy(len(layers), dtype)
    media = LayeredMedia.of(layers, anisotropy, eta_above, eta_below)
    return media, _default_edges(media, anisotropy) if edges is None else edges.astype(dtype)


def _default_edges(
    media: LayeredMedia, anisotropy: Float[Array, " layers"]
) -> Float[Array, " edges"]:
    """Rings from a fiftieth of the least mean free path to where hardly anything leaves."""
    media = jax.lax.stop_gradient(media)
    sigma_s_prime = media.sigma_s[media.first] * (1 - anisotropy[media.first])
    free_path = 1 / (media.sigma_a[media.first] + sigma_s_prime)
    sigma_tr = jnp.sqrt(3 * media.sigma_a[media.first] / free_path)
    last = jnp.max(
        jnp.minimum(200 * free_path, 20 / jnp.maximum(sigma_tr, 1e-6 / free_path) + 10 * free_path)
    )
    first = 0.02 * jnp.min(free_path)
    return jnp.concatenate(
        [
            jnp.zeros_like(first)[None],
            first * (last / first) ** jnp.linspace(0, 1, 128, dtype=first.dtype),
        ]
    )


@eqx.filter_custom_jvp
def _monte_carlo(media: LayeredMedia, setup: _Setup, *, progress) -> MonteCarlo:
    return _walk_all(media, setup, with_derivatives=False, progress=progress)[0]


@_monte_carlo.def_jvp
def _monte_carlo_jvp(primals, tangents, *, progress):
    (media, setup), (moved, moved_setup) = primals, tangents
    for name, tangent in (
        ("thickness", moved.thickness),
        ("eta", moved.eta),
        ("edges and phase", moved_setup),
    ):
        if jax.tree.leaves(tangent):
            raise ValueError(
                f"monte_carlo has no derivative in {name}: photons would fly in other directions "
                "or leave elsewhere; "
                "differentiate sigma_a and sigma_s_prime, or take differences of estimates with "
                "the same key"
            )
    found, by_absorption, by_scattering = _walk_all(
        media, setup, with_derivatives=True, progress=progress
    )
    pairs = [
        (by, tangent)
        for by, tangent in ((by_absorption, moved.sigma_a), (by_scattering, moved.sigma_s))
        if tangent is not None
    ]

    return found, _along(found, pairs)


@eqx.filter_jit
def _along(
    found: MonteCarlo, pairs: list[tuple[PathDerivatives, Float[Array, "layers channels"]]]
) -> MonteCarlo:
    """Give the derivative of an estimate along tangents of coefficients."""

    def tangent_of(name: str) -> Estimate:
        value = getattr(found, name).value
        total = jnp.zeros_like(value)
        for by, tangent in pairs:
            total = total + jnp.einsum("l...c,lc->...c", getattr(by, name).value, tangent)
        return Estimate(total, jnp.zeros_like(value))

    names = (
        "reflected",
        "transmitted",
        "total_reflectance",
        "total_transmittance",
        "absorbed",
        "unfinished",
    )
    return MonteCarlo(
        edges=jnp.zeros_like(found.edges),
        specular=jnp.zeros_like(found.specular),
        **{name: tangent_of(name) for name in names},
    )


def _walk_all(media: LayeredMedia, setup: _Setup, with_derivatives: bool, progress):
    """Walk each group of channels that walk alike, and put the channels in their order."""
    groups, parts = media.alike(), []
    for number, group in enumerate(groups):
        walk = _walk_of(
            media, setup, jnp.asarray(number), jnp.asarray(group.astype(np.int32)), with_derivatives
        )
        share = None if progress is None else _share_of(progress, number, len(groups))
        parts.append(finish(walk, share))
    order = np.argsort(np.concatenate(groups)).astype(np.int32)
    return _assemble(parts, jnp.asarray(order), media, setup, with_derivatives)


@eqx.filter_jit
def _walk_of(
    media: LayeredMedia,
    setup: _Setup,
    number: Int[Array, ""],
    group: Int[Array, " group"],
    with_derivatives: bool,
) -> Walk:
    """Give the walk of a group of channels, in the free paths of the first of them."""
    layers, unit = media.sigma_a.shape[0], media.unit[group]
    sigma_a, sigma_s = media.sigma_a[:, group], media.sigma_s[:, group]
    optics = Optics.of(sigma_a, sigma_s, unit)
    if with_derivatives:
        ones = jnp.broadcast_to(
            jnp.eye(layers, dtype=unit.dtype)[:, :, None], (layers, *sigma_a.shape)
        )
        by_absorption = jax.vmap(
            lambda t: jax.jvp(lambda a: Optics.of(a, sigma_s, unit), (sigma_a,), (t,))[1]
        )(ones)
        by_scattering = jax.vmap(
            lambda t: jax.jvp(lambda s: Optics.of(sigma_a, s, unit), (sigma_s,), (t,))[1]
        )(ones)
        slopes = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), by_absorption, by_scattering)
    else:
        slopes = jax.tree.map(lambda each: jnp.zeros((0, *each.shape), each.dtype), optics)
    return Walk(
        stack=jax.lax.stop_gradient(media.stack(group[0])),
        phase=setup.phase,
        incidence=setup.incidence,
        optics=optics,
        slopes=slopes,
        edges=setup.edges[None] / jax.lax.stop_gradient(unit)[:, None],
        photons=setup.photons,
        flights=setup.flights,
        key=jax.random.fold_in(setup.key, number),
        lanes=setup.lanes,
    )


def _share_of(
    progress: Callable[[int, int], None], number: int, groups: int
) -> Callable[[int, int], None]:
    return lambda done, photons: progress(number * photons + done, groups * photons)


@eqx.filter_jit
def _assemble(
    parts: list[Tally],
    order: Int[Array, " channels"],
    media: LayeredMedia,
    setup: _Setup,
    with_derivatives: bool,
):
    """Turn means of moments into estimates: the moments are value, square, derivatives, and their
    squares.
    """
    rings, layers = setup.edges.shape[0] - 1, media.sigma_a.shape[0] if with_derivatives else 0
    photons, others = (
        count.astype(setup.edges.dtype) for count in (setup.photons, setup.photons - 1)
    )
    left = jnp.concatenate([part.left.over(photons) for part in parts])[order]
    absorbed = jnp.concatenate([part.absorbed.over(photons) for part in parts], axis=1)[:, order]
    areas = jnp.pi * (setup.edges[1:] ** 2 - setup.edges[:-1] ** 2)
    above, below, unfinished = left[:, : rings + 1], left[:, rings + 1 : -1], left[:, -1]

    def estimate(moments: Float[Array, "*shape moments"], value: int, square: int) -> Estimate:
        mean = moments[..., value]
        variance = (moments[..., square] - mean * mean) / others
        return Estimate(mean, jnp.sqrt(jnp.maximum(variance, 0.0)))

    def all_of(value, square):
        def by_area(moments) -> Estimate:
            found = estimate(moments[:, :-1], value, square)
            return jax.tree.map(lambda each: (each / areas[None]).T, found)

        return {
            "reflected": by_area(above),
            "transmitted": by_area(below),
            "total_reflectance": estimate(jnp.sum(above, axis=1), value, square),
            "total_transmittance": estimate(jnp.sum(below, axis=1), value, square),
            "absorbed": estimate(absorbed, value, square),
            "unfinished": estimate(unfinished, value, square),
        }

    found = MonteCarlo(
        edges=setup.edges,
        specular=setup.incidence.reflected(media.eta[1] / media.eta[0]),
        **all_of(0, 1),
    )
    slopes = [
        PathDerivatives(**all_of(2 + number, 2 + 2 * layers + number))
        for number in range(2 * layers)
    ]
    stacked = [
        jax.tree.map(lambda *each: jnp.stack(each), *slopes[i : i + layers])
        for i in (0, layers)
        if layers
    ]
    return (found, *stacked)
