"""Profiles by random walks of photons."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from splatjax._records import Numbers, as_floats, check_values, is_traced, require
from splatjax.scattering import Film, Layer, check_stack

from ._results import MonteCarlo, assemble
from ._rounds import Walk, finish
from ._walk import AbstractIncidence, LayeredMedia, NormalIncidence

# Number of simultaneous photons: few enough that their state stays in the cache of a core or two
# and few lanes wait for the last photon.
_MOST_LANES, _LEAST_LANES, _PHOTONS_A_LANE = 16384, 1024, 8

# Thickness of a film in free paths of the first scattering layer, so thin that light does not move
# sideways.
_FILM_THICKNESS = 1e-6


def _shared_walks(media: LayeredMedia) -> list[np.ndarray]:
    """Group the channels, by number, that differ only in absorption and in scale and so share a
    walk. For traced values, each channel has its own walk.
    """
    geometry = jax.lax.stop_gradient((media.sigma_s, media.thickness, media.eta))
    if is_traced(geometry):
        return [np.asarray([channel]) for channel in range(media.sigma_a.shape[1])]
    sigma_s, thickness, eta = (np.asarray(values) for values in geometry)
    unit = 1 / sigma_s[media.first]
    _, group = np.unique(
        np.concatenate([sigma_s * unit, thickness / unit, eta]), axis=1, return_inverse=True
    )
    return [np.flatnonzero(group == number) for number in range(group.max() + 1)]


def monte_carlo(
    layers: Sequence[Layer | Film],
    photons: int | float,
    key: Key[Array, ""],
    *,
    edges: Numbers | None = None,
    incidence: AbstractIncidence = NormalIncidence(),
    g: Numbers = 0.0,
    eta_above: Numbers = 1.0,
    eta_below: Numbers = 1.0,
    flights: int = 20_000,
    progress: Callable[[int, int], None] | None = None,
) -> MonteCarlo:
    r"""Compute a profile by random walks of photons through layers of any thickness and absorption.
    It is the reference for all other models.

        found = monte_carlo([Layer(load_medium("skin1"), jnp.inf)], 1_000_000, jax.random.key(0))
        found.total_reflectance.value, found.total_reflectance.deviation  # [channels], with errors
        found.profile()  # a profile with error bars, to fit

    Photons move from one scattering event to the next, absorption reduces their weight, and
    interfaces reflect or refract them by Fresnel's equations. Channels that differ only in
    absorption and in scale, such as those of a half space with one index, share their walks and
    therefore their errors.

    Differentiable in `sigma_a`, `sigma_s_prime` and the optical depth of films, in forward and
    reverse mode, by likelihood ratios of the paths. The standard errors are constants.

    **Arguments:**

    - `layers`: the layers, from the top; only the lowest may be infinite.
    - `photons`: number of photons per walk; errors decrease with its square root.
    - `key`: a key of `jax.random`; the same key gives the same result.
    - `edges`: edges of the rings, mm, ascending. By default 128 rings with geometric spacing,
      starting at a fiftieth of a mean free path.
    - `incidence`: `NormalIncidence()` or `DiffuseIncidence()`.
    - `g`: mean cosine of the Henyey-Greenstein phase function, between -1 and 1, one number or one
      per layer; `sigma_s = sigma_s' / (1 - g)`.
    - `eta_above`, `eta_below`: indices of the neighbors relative to air.
    - `flights`: largest number of flights, from one event to the next, of a photon. The power that
      remains is counted in `unfinished`.
    - `progress`: called about once a second with the number of finished photons and the total
      number.

    **Returns:** a `MonteCarlo`.

    **Raises:** `ValueError` without a scattering layer, for unequal numbers of channels, for an
    infinite layer above another layer, for fewer than 2 or at least 2^30 photons, for a `g` out of
    its range, for edges that do not ascend, and for derivatives with respect to other arguments.

    **Source:** Wang, Jacques and Zheng 1995 (MCML); one walk for many absorptions: Kienle and
    Patterson 1996; path weights: Hayakawa et al. 2001.
    """
    for name, number, least in (("photons", photons, 2), ("flights", flights, 1)):
        check_values(
            name,
            number,
            f"at least {least}, and below 2^30",
            lambda x, least=least: (x >= least) & (x < 2**30),
        )
    photons, layers = int(photons), tuple(layers)
    check_stack(layers)
    dtype = next(layer.medium.sigma_a.dtype for layer in layers if isinstance(layer, Layer))
    above, below, g = (as_floats(values, dtype) for values in (eta_above, eta_below, g))
    check_values("g", g, "between -1 and 1, both excluded", lambda x: abs(x) < 1)
    require(
        g.shape in ((), (len(layers),)),
        f"g must be one number, or one for each of the {len(layers)} layers; got {g.size}",
    )
    media, rings = _lay_out(layers, g, above, below)
    edges = rings if edges is None else as_floats(edges, dtype)
    check_values("the number of edges", len(edges), "at least 2", lambda x: x > 1)
    check_values("edges", edges, "at least 0 (mm)", lambda x: x >= 0)
    check_values(
        "the steps of edges",
        jnp.diff(edges),
        "positive (mm), with ascending edges",
        lambda x: x > 0,
    )
    lanes = max(_LEAST_LANES, 1 << (photons // _PHOTONS_A_LANE).bit_length())
    settings = {
        "incidence": incidence,
        "photons": jnp.asarray(photons, jnp.int32),
        "flights": jnp.asarray(flights, jnp.int32),
        "lanes": min(_MOST_LANES, lanes),
    }
    groups, means = _shared_walks(media), []
    for number, group in enumerate(groups):
        walk = _walk_of(
            media, jnp.asarray(number), jnp.asarray(group, jnp.int32), edges, key, **settings
        )
        report = progress and (
            lambda done, before=number: progress(before * photons + done, len(groups) * photons)
        )
        means.append(_mean_moments(walk, progress=report))
    order = jnp.asarray(np.argsort(np.concatenate(groups)).astype(np.int32))
    return assemble(
        jnp.concatenate(means)[order],
        edges,
        settings["photons"],
        incidence.reflected(media.eta[1] / media.eta[0]),
    )


@eqx.filter_jit
def _lay_out(layers, g, eta_above, eta_below):
    """Convert layers to arrays, and compute default ring edges. A film has the index of the next
    scattering layer below it or, if there is none, of the last one above.
    """
    scattering = [layer for layer in layers if isinstance(layer, Layer)]
    top, g = jax.lax.stop_gradient(scattering[0].medium), jnp.broadcast_to(g, len(layers))
    thin, none = _FILM_THICKNESS / top.sigma_s_prime, jnp.zeros_like(top.sigma_a)
    rows = []
    for number, layer in enumerate(layers):
        lower = [candidate for candidate in layers[number:] if isinstance(candidate, Layer)]
        medium = (lower or scattering[-1:])[0].medium
        if isinstance(layer, Film):
            rows.append((layer.optical_depth / thin, none, thin, medium.eta))
        else:
            sigma_s = medium.sigma_s_prime / (1 - g[number])
            thickness = jnp.broadcast_to(layer.thickness, none.shape)
            rows.append((medium.sigma_a, sigma_s, thickness, medium.eta))
    sigma_a, sigma_s, thickness, eta = (jnp.stack(column) for column in zip(*rows, strict=True))
    above, below = (jnp.broadcast_to(edge, none.shape)[None] for edge in (eta_above, eta_below))
    first = [isinstance(layer, Layer) for layer in layers].index(True)
    eta = jnp.concatenate([above, eta, below])
    media = LayeredMedia(sigma_a, sigma_s, thickness, eta, g, first)

    free_path = 1 / top.sigma_t_prime
    fallen = 20 / jnp.maximum(jnp.sqrt(top.squared_sigma_tr), 1e-6 / free_path) + 10 * free_path
    inner, outer = 0.02 * jnp.min(free_path), jnp.max(jnp.minimum(200 * free_path, fallen))
    growing = inner * (outer / inner) ** jnp.linspace(0, 1, 128, dtype=inner.dtype)
    return media, jnp.concatenate([jnp.zeros(1, inner.dtype), growing])


@eqx.filter_custom_jvp
def _mean_moments(walk: Walk, *, progress) -> Float[Array, "channels places two"]:
    """Compute the means of weights and of their squares by channel and place."""
    return finish(walk, False, progress)


@_mean_moments.def_jvp
def _mean_moments_jvp(primals, tangents, *, progress):
    (walk,), (walk_dot,) = primals, tangents
    media, media_dot = walk.media, walk_dot.media
    for name, tangent in (
        ("thickness", media_dot.thickness),
        ("eta", media_dot.eta),
        ("edges and g", (media_dot.g, walk_dot.edges, walk_dot.incidence)),
    ):
        require(
            not jax.tree.leaves(tangent),
            f"monte_carlo has no derivative in {name}, which changes the paths of photons; "
            "differentiate sigma_a and sigma_s_prime, or take differences of results with the "
            "same key",
        )
    moments = finish(walk, True, progress)
    none = jnp.zeros_like(media.sigma_a)
    along = [none if dot is None else dot for dot in (media_dot.sigma_a, media_dot.sigma_s)]
    slope = jnp.einsum("crp,pc->cr", moments[..., 2:], jnp.concatenate(along))
    return moments[..., :2], jnp.stack([slope, jnp.zeros_like(slope)], axis=-1)


@eqx.filter_jit
def _walk_of(
    media: LayeredMedia,
    number: Int[Array, ""],
    group: Int[Array, " group"],
    edges: Float[Array, " edges"],
    key: Key[Array, ""],
    **settings,
) -> Walk:
    """Set up the walk of a group of channels, with lengths in free paths of each channel."""
    # The unit of length: the scattering free path in the first scattering layer, mm.
    unit = jax.lax.stop_gradient(1 / media.sigma_s[media.first, group])
    in_free_paths = LayeredMedia(
        media.sigma_a[:, group] * unit[None],
        media.sigma_s[:, group] * unit[None],
        media.thickness[:, group] / unit[None],
        media.eta[:, group],
        media.g,
        media.first,
    )
    return Walk(
        in_free_paths, edges[None] / unit[:, None], jax.random.fold_in(key, number), **settings
    )
