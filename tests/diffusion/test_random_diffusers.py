"""The fast diffuser on random scenes: without clusters the plain sum over the sources within its
support, in value and gradient.

With `error=0` nothing is merged. What is left out is then known to the last source, so that its
lists are held to rounding, not to the support's error; and that error is what the untruncated sum
has beyond the support.
"""

from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_bodies import KINDS, disagreement, random_body, seeds
from splatjax.diffusion._pixels import tile_grid

from splatjax.diffusion import ClusterDiffuser, DenseDiffuser, Kernels, Sources
from splatjax.diffusion._clustered import LayerPlan
from splatjax.scene import Splats
from splatjax.splatting import SIDE, BinCapacity, DenseRasterizer, SplattingSettings, TileGrid

WIDTH, HEIGHT = 19, 14
CHANNELS = 2
IN_SUITE = 45
RESOLVED = (0.0, 0.0)  # an interval that hands no layer over
VALUE, GRADIENT = 1e-10, 1e-8  # float64: the same sums in another order


def with_room(diffuser: ClusterDiffuser, count: int) -> ClusterDiffuser:
    """Give room for every source in every tile, at any variance: one program for all scenes."""
    grid = tile_grid(WIDTH, HEIGHT, 4)
    blocks, chunks = -(-count // 64) * 4, grid.tiles // grid.lanes
    pairs = -(-2 * blocks * grid.tiles // 1024) * 1024
    room = BinCapacity(pairs, chunks * -(-2 * blocks // grid.slots), chunks)
    layers = tuple(
        LayerPlan(each.level, each.support, jnp.zeros(()), jnp.full((), jnp.inf), room, each.nodes)
        for each in diffuser.layers or ()
    )
    return eqx.tree_at(lambda d: d.layers, diffuser, layers)


def within_support(sources: Sources, kernels: Kernels, points, covered, supports: list[float]):
    """Give means and exits, written down plainly; 0 where no source is within the support."""
    found = []
    for variance, depth, support in zip(kernels.variances, kernels.depths, supports, strict=True):
        offset = points[:, :, :, None] - (sources.centers - depth * sources.normals)[None, :, None]
        exponent = 0.5 * jnp.sum(offset * offset, axis=1) / variance
        left = jnp.clip(
            2 * (0.5 * support**2 - exponent), 0, 1
        )  # fading over the last half of an exponent
        weight = jnp.exp(-exponent) * left * sources.areas[None, None]
        gathered = jnp.sum(weight, axis=-1)
        reached = covered & (gathered > 0)
        means = (
            jnp.einsum("cj,tpj->tcp", sources.irradiance, weight)
            / jnp.where(reached, gathered, 1.0)[:, None]
        )
        exits = gathered * jnp.exp(0.5 * depth * depth / variance) / (2 * jnp.pi * variance)
        found.append(
            jnp.where(reached[:, None], jnp.concatenate([means, exits[:, None]], axis=1), 0.0)
        )
    return jnp.stack(found, axis=1)


class Scene(eqx.Module):
    """All that pass 4 is differentiated in."""

    sources: Sources
    kernels: Kernels
    depths: jax.Array
    view: eqx.Module


def gaussians_of(count: int) -> int:
    """Two layers of many splats; of one splat one, which is sooner compiled."""
    return 2 if count > 1 else 1


def random_scene(seed: int, count: int) -> tuple[Splats, Scene, jax.Array]:
    """Draw splats, layers from far narrower than the splats lie apart to wider than all, and two
    surfaces amid the splats.
    """
    body, view = random_body(seed, count, True, WIDTH, HEIGHT)
    rng = np.random.default_rng([seed, count])
    body = eqx.tree_at(lambda s: s.areas, body, jnp.asarray(np.exp(rng.normal(size=count))))
    depths = np.exp(
        rng.normal(size=(2, HEIGHT, WIDTH)) * rng.choice([0.02, 0.5]) + np.log(rng.uniform(4, 40))
    )
    _, points, _ = bodies.packed(jnp.asarray(depths), jnp.ones(depths.shape), view)
    away = np.linalg.norm(
        np.asarray(points)[..., None] - np.asarray(body.centers).T[None, :, None], axis=1
    )
    gaussians = gaussians_of(count)
    variances = np.quantile(away, 10 ** rng.uniform(-2, 0, gaussians)) ** 2 / rng.uniform(
        1, 10, gaussians
    )
    covered = rng.uniform(size=depths.shape) < rng.choice(
        [0.0, 0.3, 1.0], (2, 1, 1), p=[0.1, 0.3, 0.6]
    )
    irradiance = rng.uniform(size=(CHANNELS, count)) * (rng.uniform(size=(CHANNELS, count)) < 0.7)
    kernels = Kernels(
        jnp.asarray(variances), jnp.asarray(rng.choice([0.0, 0.75]) * np.sqrt(variances))
    )
    sources = Sources(body.centers.T, body.normals.T, body.areas, jnp.asarray(irradiance))
    return body, Scene(sources, kernels, jnp.asarray(depths), view), jnp.asarray(covered)


@cache
def by_both(count: int):
    """Give a function of a scene: values and gradients of a random sum of them, of the fast
    diffuser and of the plain sum.
    """
    tiles = tile_grid(WIDTH, HEIGHT, 1)
    shape = tiles.count, gaussians_of(count), CHANNELS + 1, SIDE**2
    factors = jnp.asarray(np.random.default_rng(count).normal(size=shape))

    def stacked(found):
        return jnp.concatenate([found.means, found.exits[:, :, None]], axis=2)

    @jax.jit
    def both(diffuser: ClusterDiffuser, scene: Scene, covered):
        def seen(scene):
            return bodies.packed(scene.depths, covered.astype(scene.depths.dtype), scene.view)

        def fast(scene: Scene):
            atlas, points, there = seen(scene)
            found = diffuser.diffuse(scene.sources, scene.kernels, points, there, atlas)
            return stacked(found), found.needed

        def plain(scene: Scene):
            _, points, there = seen(scene)
            supports = [layer.support for layer in diffuser.layers or ()]
            return within_support(scene.sources, scene.kernels, points, there, supports), jnp.zeros(
                ()
            )

        # Exits are areas over that of the kernel: times it all are as large, and no sum is drowned
        # in another's rounding.
        flat = 2 * jnp.pi * scene.kernels.variances
        as_large = jnp.stack([*[jnp.ones_like(flat)] * CHANNELS, flat], axis=1)[None, :, :, None]

        def found(diffuse):
            def total(scene):
                values, needed = diffuse(scene)
                return jnp.vdot(factors * as_large, values), (values, needed)

            return jax.value_and_grad(total, has_aux=True)(scene)

        atlas, points, there = seen(scene)
        untruncated = DenseDiffuser().diffuse(scene.sources, scene.kernels, points, there, atlas)
        return found(fast), found(plain), stacked(untruncated)

    return both


@pytest.mark.parametrize("count", [80, 1])
def test_without_clusters_all_within_the_support_is_summed(float64, count):
    both, worst, reached = by_both(count), {}, 0
    for seed in seeds(IN_SUITE if count > 1 else len(KINDS)):
        body, scene, covered = random_scene(seed, count)
        atlas, _, _ = bodies.packed(scene.depths, covered.astype(float), scene.view)
        diffuser = ClusterDiffuser(error=0.0).planned(
            body, scene.kernels, jnp.asarray(RESOLVED), [atlas]
        )
        found, expected, untruncated = both(with_room(diffuser, count), scene, covered)
        (_, (values, needed)), gradients = found
        (_, (plain, _)), plain_gradients = expected
        assert float(needed) <= 1
        reached += int(jnp.sum(plain[:, :, -1] > 0))
        pairs = {
            "means": (values[:, :, :-1], plain[:, :, :-1]),
            "exits": (values[:, :, -1], plain[:, :, -1]),
        }
        names = jax.tree_util.tree_flatten_with_path(plain_gradients)[0]
        leaves = zip(names, jax.tree.leaves(gradients), strict=True)
        pairs |= {jax.tree_util.keystr(path): (ours, theirs) for (path, theirs), ours in leaves}
        for name, (ours, theirs) in pairs.items():
            assert np.all(np.isfinite(theirs)), (seed, name)
            error = disagreement(ours, theirs)
            assert error < (VALUE if name in ("means", "exits") else GRADIENT), (
                f"scene {seed}: {name} differ by {error:.1e}"
            )
            worst[name] = max(worst.get(name, 0.0), error)
        # What the support leaves out is missing from the exits; the mean of the rest is another by
        # so much of the range.
        left_out = 1 - plain[:, :, -1:] / jnp.maximum(untruncated[:, :, -1:], 1e-300)
        off = jnp.abs(values - untruncated)[:, :, :-1] - left_out * jnp.ptp(
            scene.sources.irradiance
        )
        assert float(jnp.max(jnp.where(plain[:, :, -1:] > 0, off, 0.0))) < VALUE
    print(
        {name: f"{error:.1e}" for name, error in worst.items()},
        f"{reached} points of layers reached",
    )
    assert reached > 1000


COUNT, SIZE = 1500, 24
VARIANCES = (14.0, 40.0)
LIT_IN_SUITE = 7  # one for each of what a layer is differentiated in
# Of a layer's root mean square, as `ClusterDiffuser.error` states them; of the exits a layer passes
# on a part.
MEDIAN, EXITS_MEDIAN, HIGH = 2e-3, 3e-3, 1e-2
STEP, AGREEMENT = 1e-6, 1e-5  # of differences along a random way; 4e-7 found


class WideDiffuser(ClusterDiffuser):
    """Of so wide a support that only clusters and nodes err, and no difference steps over its
    rim.
    """

    def support(self, share: float) -> float:
        return 7.0


class Lit(eqx.Module):
    """A body that moves a little, lit anew, with layers of other widths, and the points that are
    seen of it.
    """

    sources: Sources
    kernels: Kernels
    points: jax.Array


@cache
def seen_of():
    """Give a function of body and view: depths, sums of weights and coverage of both surfaces."""
    nothing = jnp.zeros((0, COUNT))

    @jax.jit
    def look(body, view):
        surfaces = bodies.drawn(body, nothing, view, SplattingSettings(), DenseRasterizer())
        both = surfaces.front, surfaces.behind
        return tuple(
            jnp.stack([getattr(each, name) for each in both])
            for name in ("depth", "weight_sum", "coverage")
        )

    return look


@cache
def body_and_plan() -> tuple[Splats, list, ClusterDiffuser]:
    """One plan for all cameras."""
    body, rng = bodies.bumpy(COUNT), np.random.default_rng(3)
    eyes = rng.normal(size=(LIT_IN_SUITE, 3))
    eyes *= rng.uniform(30, 50, (LIT_IN_SUITE, 1)) / np.linalg.norm(eyes, axis=1, keepdims=True)
    views = [bodies.perspective(eye, fov=32.0, width=SIZE, height=SIZE) for eye in eyes]
    kernels = Kernels(jnp.asarray(VARIANCES), 0.75 * jnp.sqrt(jnp.asarray(VARIANCES)))
    atlases = [bodies.packed(*seen_of()(body, view)[:2], view)[0] for view in views]
    diffuser = WideDiffuser().planned(body, kernels, jnp.asarray(RESOLVED), atlases)
    assert diffuser.layers is not None
    assert [layer.level for layer in diffuser.layers] == [1, 2]
    assert all(layer.nodes is not None for layer in diffuser.layers)
    return body, views, diffuser


def lit(seed: int):
    """Light from a side, textured; behind the edge of a shadow there is none."""
    body, views, _ = body_and_plan()
    rng, view = np.random.default_rng(seed), views[seed % LIT_IN_SUITE]
    body = eqx.tree_at(
        lambda s: s.centers, body, body.centers + jnp.asarray(rng.normal(size=(COUNT, 3)) * 0.02)
    )
    depths, weight_sums, coverage = seen_of()(body, view)
    centers, normals = np.asarray(body.centers), np.asarray(body.normals)
    to_light, across = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    waves = [
        np.sin(centers @ rng.normal(size=3) * rng.uniform(0.2, 1.0) + rng.uniform(0, 6))
        for _ in range(2)
    ]
    irradiance = np.stack(
        [np.maximum(normals @ to_light, 0) * (1 + 0.3 * waves[0]), (1 + 0.5 * waves[1])]
    )
    irradiance[1] *= 1 / (1 + np.exp(-4 * (centers @ across - rng.uniform(-5, 5))))
    factors = np.exp(rng.uniform(np.log(0.85), np.log(1.2), len(VARIANCES)))
    variances = jnp.asarray(VARIANCES) * jnp.asarray(factors)
    sources = Sources(body.centers.T, body.normals.T, body.areas, jnp.asarray(irradiance))
    atlas, points, covered = bodies.packed(depths, weight_sums, view)
    # By coverage pictures multiply; where it is small, the point lies off the body.
    front = TileGrid(SIZE, SIZE).cut(coverage[:1])[:, 0]
    seen = np.asarray((atlas.pack(front, jnp.zeros_like(front)) > 0.5) & atlas.in_front[:, None])
    return (
        Lit(sources, Kernels(variances, 0.75 * jnp.sqrt(variances)), points),
        covered,
        seen,
        atlas,
    )


@cache
def through_clusters():
    tiles = tile_grid(SIZE, SIZE, 1)
    shape = tiles.count, len(VARIANCES), CHANNELS + 1, SIDE**2
    factors = jnp.asarray(np.random.default_rng(1).normal(size=shape))
    _, _, diffuser = body_and_plan()

    def run(each, scene, covered, atlas):
        found = each.diffuse(scene.sources, scene.kernels, scene.points, covered, atlas)
        return jnp.concatenate([found.means, found.exits[:, :, None]], axis=2), found.needed

    @jax.jit
    def fast(scene: Lit, covered, atlas):
        def total(scene):
            values, needed = run(diffuser, scene, covered, atlas)
            return jnp.vdot(factors, values), (values, needed)

        return jax.value_and_grad(total, has_aux=True)(scene)

    return fast, jax.jit(lambda *scene: run(DenseDiffuser(), *scene)[0])


def test_clusters_err_as_stated_and_their_gradient_is_that_of_differences(float64):
    """Errors are those of all scenes together; each scene is moved along one of the things it is
    differentiated in.
    """
    fast, plain = through_clusters()
    errors, slopes = {}, {}
    for seed in seeds(LIT_IN_SUITE):
        scene, covered, seen, atlas = lit(seed)
        (_, (values, needed)), gradient = fast(scene, covered, atlas)
        assert float(needed) <= 1
        expected = np.asarray(plain(scene, covered, atlas))
        for k in range(len(VARIANCES)):
            for row, name in enumerate(("mean", "mean", "exits")):
                ours, theirs = np.asarray(values)[:, k, row][seen], expected[:, k, row][seen]
                errors.setdefault((k, name), []).append(
                    np.abs(ours - theirs) / np.sqrt(np.mean(theirs**2))
                )
        leaves, structure = jax.tree.flatten(scene)
        moved = seed % len(leaves)
        way = jnp.asarray(np.random.default_rng(seed).normal(size=leaves[moved].shape)) * jnp.mean(
            jnp.abs(leaves[moved])
        )

        def total(
            step,
            leaves=leaves,
            moved=moved,
            way=way,
            structure=structure,
            covered=covered,
            atlas=atlas,
        ):
            there = structure.unflatten(
                [leaf + step * way if i == moved else leaf for i, leaf in enumerate(leaves)]
            )
            return float(fast(there, covered, atlas)[0][0])

        difference = (total(STEP) - total(-STEP)) / (2 * STEP)
        along = jax.tree.leaves(gradient)[moved]
        typical = float(jnp.linalg.norm(along) * jnp.linalg.norm(way)) / np.sqrt(
            way.size
        )  # a way may happen to lead nowhere
        slopes[moved] = max(
            slopes.get(moved, 0.0), abs(float(jnp.vdot(along, way)) - difference) / typical
        )
    pooled = {key: np.quantile(np.concatenate(each), [0.5, 0.99]) for key, each in errors.items()}
    print({key: f"{median:.1e} {high:.1e}" for key, (median, high) in pooled.items()})
    print({place: f"{error:.1e}" for place, error in slopes.items()})
    assert len(slopes) == len(leaves)
    assert max(slopes.values()) < AGREEMENT, slopes
    for (k, name), (median, high) in pooled.items():
        assert median < (MEDIAN if name == "mean" else EXITS_MEDIAN), (k, name, median)
        assert high < HIGH, (k, name, high)
