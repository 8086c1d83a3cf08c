"""Profiles by random walks, the reference that diffusion approximates."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Key

from splatjax._records import Numbers, as_floats, check_values
from splatjax.scattering import Film, Layer, check_stack

from ._directions import AbstractIncidence, AbstractPhaseFunction, Isotropic, NormalIncidence
from ._results import AbstractTallies, MonteCarlo, PathDerivatives, SampleMean, assemble
from ._rounds import Walk, WalkSettings, finish
from ._walk import Optics, Stack

_FLIGHTS = 20_000

# Number of simultaneous photons: their state stays in the cache of a core or two, and few lanes
# wait for the last photon.
_MOST_LANES, _LEAST_LANES, _PHOTONS_A_LANE = 16384, 1024, 8

# In free paths of the first scattering layer: so thin that light does not move sideways in a film.
_FILM_THICKNESS = 1e-6


class LayeredMedia(eqx.Module):
    r"""Layers, films among them, as arrays over all channels.

    **Attributes:**

    - `sigma_a`, `sigma_s`: 1/mm; a film does not scatter, and has its optical depth over its
      thickness.
    - `thickness`: mm.
    - `eta`: indices relative to air, those of the neighbors above and below included.
    - `first`: number of the uppermost layer that scatters.
    """

    sigma_a: Float[Array, "layers channels"]
    sigma_s: Float[Array, "layers channels"]
    thickness: Float[Array, "layers channels"]
    eta: Float[Array, "layers_and_neighbors channels"]
    first: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        layers: Sequence[Layer | Film],
        anisotropy: Float[Array, " layers"],
        eta_above: Float[Array, "*channels"],
        eta_below: Float[Array, "*channels"],
    ) -> "LayeredMedia":
        """Convert layers, from the top. A film has the index of the next scattering layer below it,
        or else of the last one above.
        """
        scattering = [layer for layer in layers if isinstance(layer, Layer)]
        like = scattering[0].medium.sigma_a
        thin = _FILM_THICKNESS / jax.lax.stop_gradient(scattering[0].medium.sigma_s_prime)
        rows = []
        for number, layer in enumerate(layers):
            lower = [other for other in layers[number:] if isinstance(other, Layer)]
            medium = (lower or scattering[-1:])[0].medium
            if isinstance(layer, Film):
                rows.append((layer.optical_depth / thin, jnp.zeros_like(like), thin, medium.eta))
            else:
                sigma_s = medium.sigma_s_prime / (1 - anisotropy[number])
                thickness = jnp.broadcast_to(layer.thickness, like.shape)
                rows.append((medium.sigma_a, sigma_s, thickness, medium.eta))
        sigma_a, sigma_s, thickness, eta = (jnp.stack(column) for column in zip(*rows, strict=True))
        above, below = (jnp.broadcast_to(edge, (1, len(like))) for edge in (eta_above, eta_below))
        first = next(number for number, layer in enumerate(layers) if isinstance(layer, Layer))
        return cls(sigma_a, sigma_s, thickness, jnp.concatenate([above, eta, below]), first)

    def shared_walks(self) -> list[np.ndarray]:
        """Group the channels, by number, that differ in absorption and in scale alone: they share a
        walk.

        Under `jit`, where values are unknown, each channel has its own walk.
        """
        geometry = (self.sigma_s, self.thickness, self.eta)
        if any(isinstance(values, Tracer) for values in geometry):
            return [np.asarray([channel]) for channel in range(self.sigma_a.shape[1])]
        sigma_s, thickness, eta = (np.asarray(values) for values in geometry)
        unit = 1 / sigma_s[self.first]
        _, group = np.unique(
            np.concatenate([sigma_s * unit, thickness / unit, eta]), axis=1, return_inverse=True
        )
        return [np.flatnonzero(group == number) for number in range(group.max() + 1)]


def monte_carlo(
    layers: Sequence[Layer | Film],
    photons: int,
    key: Key[Array, ""],
    *,
    edges: Numbers | None = None,
    incidence: AbstractIncidence = NormalIncidence(),
    phase: AbstractPhaseFunction = Isotropic(),
    eta_above: Numbers = 1.0,
    eta_below: Numbers = 1.0,
    flights: int = _FLIGHTS,
    progress: Callable[[int, int], None] | None = None,
) -> MonteCarlo:
    r"""Walk photons through layers and count where they leave, without the limits of diffusion on
    thickness and absorption.

    Photons fly from one scattering event to the next; absorption reduces their weight; interfaces
    reflect or refract them by Fresnel's formulas. Channels that differ only in absorption, or only
    in scale (a half space of one index), share their walks, and therefore their errors.

    Differentiable in `sigma_a`, `sigma_s_prime` and the optical depth of films, in forward and
    reverse mode, by the likelihood of each path. The standard errors are constants; those of
    derivatives: `path_derivatives`.

    **Arguments:**

    - `layers`: from the top; only the lowest may be infinite.
    - `photons`: number of photons for each walk; errors decrease with its root.
    - `key`: of `jax.random`; the same key gives the same numbers.
    - `edges`: of the rings, mm; ascending. By default 128 rings whose widths grow in proportion,
      from a fiftieth of a mean free path.
    - `incidence`: `NormalIncidence()` or `DiffuseIncidence()`.
    - `phase`: `Isotropic()` or `HenyeyGreenstein(g)`; `sigma_s = sigma_s' / (1 - g)`.
    - `eta_above`, `eta_below`: indices of the neighbors relative to air.
    - `flights`: largest number of flights from event to event for each photon; its power after them
      is `unfinished`.
    - `progress`: called from time to time with the number of photons done and that of all.

    **Returns:** a `MonteCarlo`.

    **Raises:** `ValueError` for no scattering layer, for numbers of channels that differ, for an
    infinite layer above another, for a number of photons below 2 or not below 2^30, for edges that
    do not ascend, and for derivatives in other arguments.

    **Source:** Wang, Jacques and Zheng 1995 (MCML); one walk for many absorptions: Kienle and
    Patterson 1996; path weights: Hayakawa et al. 2001.
    """
    media, settings = _set_up(
        layers,
        photons,
        key,
        edges=edges,
        incidence=incidence,
        phase=phase,
        eta_above=eta_above,
        eta_below=eta_below,
        flights=flights,
    )
    return _monte_carlo(media, settings, progress=progress)


def path_derivatives(
    layers: Sequence[Layer | Film],
    photons: int,
    key: Key[Array, ""],
    *,
    progress: Callable[[int, int], None] | None = None,
    **settings,
) -> tuple[MonteCarlo, PathDerivatives, PathDerivatives]:
    r"""Compute the results of `monte_carlo`, and their derivatives in `sigma_a` and `sigma_s`
    (1/mm) of each layer, with standard errors.

    **Arguments:** those of `monte_carlo`.

    **Returns:** the results, and their derivatives by absorption and by scattering. The absorption
    coefficient of a film is its optical depth over its thickness, a millionth of a free path.
    """
    return _walk_all(*_set_up(layers, photons, key, **settings), True, progress)


def _set_up(
    layers: Sequence[Layer | Film],
    photons: int,
    key: Key[Array, ""],
    *,
    edges: Numbers | None = None,
    incidence: AbstractIncidence = NormalIncidence(),
    phase: AbstractPhaseFunction = Isotropic(),
    eta_above: Numbers = 1.0,
    eta_below: Numbers = 1.0,
    flights: int = _FLIGHTS,
) -> tuple[LayeredMedia, WalkSettings]:
    """Check and complete the arguments of `monte_carlo`."""
    for name, number, least in (("photons", photons, 2), ("flights", flights, 1)):
        check_values(
            name,
            number,
            f"at least {least}, and below 2^30",
            lambda x, least=least: (x >= least) & (x < 2**30),
        )
    layers = tuple(layers)
    check_stack(layers)
    dtype = next(layer.medium.sigma_a.dtype for layer in layers if isinstance(layer, Layer))
    above, below = as_floats(eta_above, dtype), as_floats(eta_below, dtype)
    edges = None if edges is None else as_floats(edges, dtype)
    media, edges = _prepare(layers, phase, above, below, edges)
    check_values("edges", edges, "at least two, from 0 mm on", lambda x: (x >= 0) & (len(x) > 1))
    steps = jnp.diff(edges)
    check_values(
        "the steps of edges", steps, "positive (mm), with ascending edges", lambda x: x > 0
    )
    numbers = jnp.asarray(photons, jnp.int32), jnp.asarray(flights, jnp.int32)
    lanes = max(_LEAST_LANES, 1 << (photons // _PHOTONS_A_LANE).bit_length())
    return media, WalkSettings(edges, incidence, phase, key, *numbers, min(_MOST_LANES, lanes))


@eqx.filter_jit
def _prepare(layers, phase: AbstractPhaseFunction, eta_above, eta_below, edges):
    """Lay out the media, and, unless there are others, rings as far as light leaves."""
    media = LayeredMedia.of(
        layers, phase.anisotropy(len(layers), eta_above.dtype), eta_above, eta_below
    )
    if edges is not None:
        return media, edges
    top = jax.lax.stop_gradient(layers[media.first].medium)
    free_path = 1 / top.sigma_t_prime
    fallen = 20 / jnp.maximum(jnp.sqrt(top.squared_sigma_tr), 1e-6 / free_path) + 10 * free_path
    first, last = 0.02 * jnp.min(free_path), jnp.max(jnp.minimum(200 * free_path, fallen))
    growing = first * (last / first) ** jnp.linspace(0, 1, 128, dtype=first.dtype)
    return media, jnp.concatenate([jnp.zeros(1, first.dtype), growing])


@eqx.filter_custom_jvp
def _monte_carlo(media: LayeredMedia, settings: WalkSettings, *, progress) -> MonteCarlo:
    return _walk_all(media, settings, False, progress)[0]


@_monte_carlo.def_jvp
def _monte_carlo_jvp(primals, tangents, *, progress):
    (media, settings), (media_dot, settings_dot) = primals, tangents
    for name, tangent in (
        ("thickness", media_dot.thickness),
        ("eta", media_dot.eta),
        ("edges and phase", settings_dot),
    ):
        if jax.tree.leaves(tangent):
            raise ValueError(
                f"monte_carlo has no derivative in {name}, which changes the paths of photons; "
                "differentiate sigma_a and sigma_s_prime, or take differences of results with "
                "the same key"
            )
    result, by_absorption, by_scattering = _walk_all(media, settings, True, progress)
    pairs = [(by_absorption, media_dot.sigma_a), (by_scattering, media_dot.sigma_s)]
    return result, _along(result, [pair for pair in pairs if pair[1] is not None])


@eqx.filter_jit
def _along(
    result: MonteCarlo, pairs: list[tuple[PathDerivatives, Float[Array, "layers channels"]]]
) -> MonteCarlo:
    """Compute the derivative of a result along tangents of coefficients."""

    def tangent_of(name: str) -> SampleMean:
        zero = jnp.zeros_like(getattr(result, name).value)
        slopes = (
            jnp.einsum("l...c,lc->...c", getattr(by, name).value, tangent) for by, tangent in pairs
        )
        return SampleMean(sum(slopes, start=zero), zero)

    return MonteCarlo(
        edges=jnp.zeros_like(result.edges),
        specular=jnp.zeros_like(result.specular),
        **{name: tangent_of(name) for name in AbstractTallies.__dataclass_fields__},
    )


def _walk_all(media: LayeredMedia, settings: WalkSettings, with_derivatives: bool, progress):
    """Walk each group of channels that share a walk, and put the channels in their order."""
    groups, tallies = media.shared_walks(), []
    for number, group in enumerate(groups):
        walk = _walk_of(
            media,
            settings,
            jnp.asarray(number),
            jnp.asarray(group.astype(np.int32)),
            with_derivatives,
        )
        report = progress and (
            lambda done, photons, before=number: progress(
                before * photons + done, len(groups) * photons
            )
        )
        tallies.append(finish(walk, report))
    order = jnp.asarray(np.argsort(np.concatenate(groups)).astype(np.int32))
    specular = settings.incidence.reflected(media.eta[1] / media.eta[0])
    layers = media.sigma_a.shape[0] if with_derivatives else 0
    return assemble(tallies, order, settings.edges, settings.photons, specular, layers)


@eqx.filter_jit
def _walk_of(
    media: LayeredMedia,
    settings: WalkSettings,
    number: Int[Array, ""],
    group: Int[Array, " group"],
    with_derivatives: bool,
) -> Walk:
    """Set up the walk of a group of channels, in the free paths of the first of them."""
    # The unit of length: the free path between scatterings in the first layer that scatters, mm.
    unit = 1 / media.sigma_s[media.first, group]
    coefficients = media.sigma_a[:, group], media.sigma_s[:, group]
    thickness, eta = media.thickness[:, group[0]], media.eta[:, group[0]]
    stack = Stack(media.sigma_s[:, group[0]] * unit[0], thickness / unit[0], eta)
    optics = eqx.Partial(Optics.of, unit=unit)
    # A direction for the absorption of each layer, then one for the scattering of each.
    layers = media.sigma_a.shape[0]
    slopes = 2 * layers if with_derivatives else 0
    directions = jnp.eye(slopes, 2 * layers, dtype=unit.dtype).reshape(slopes, 2, layers, 1)
    directions = jnp.broadcast_to(directions, (slopes, 2, layers, len(group)))
    slopes = jax.vmap(lambda along: jax.jvp(optics, coefficients, tuple(along))[1])(directions)
    return Walk(
        settings=settings,
        key=jax.random.fold_in(settings.key, number),
        stack=jax.lax.stop_gradient(stack),
        optics=optics(*coefficients),
        slopes=slopes,
        edges=settings.edges[None] / jax.lax.stop_gradient(unit)[:, None],
    )
