"""Splats that come a part at a time make the picture of all at once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import apart, joined, sphere

import splatjax as sj
from splatjax.diffusion import FINEST, DenseDiffuser
from splatjax.diffusion._clusters import ClusterTree
from splatjax.render._statistics import StreamStatistics
from splatjax.splatting import ShadowSettings

pytestmark = pytest.mark.once

ROUNDING = 3e-5  # of the largest number of its kind: sums of a thousand terms, in another order
LAYERS = 2.5e-2  # 99% of the pixels; at points here and at splats there, with clusters of each part
RIMS = 0.1  # where a pixel blends two surfaces, 0.07 measured
SHADOWS = ShadowSettings(resolution=32)
FIELDS = (
    "coverage",
    "depth",
    "position",
    "normal",
    "albedo",
    "shadow",
    "irradiance",
    "specular",
    "unresolved_fraction",
)
LIGHTS = (
    sj.DirectionalLight(jnp.asarray([0.4, -0.5, -1.0], float), jnp.ones(3)),
    sj.PointLight(jnp.asarray([-60.0, 10.0, 20.0], float), 2000 * jnp.ones(3), cast_shadows=False),
)
MATERIAL = sj.Material(
    sj.SumOfGaussians(
        jnp.asarray([0.1, 9.0, 60.0], float),
        jnp.asarray([[0.2, 0.1, 0.1], [0.3, 0.3, 0.2], [0.3, 0.2, 0.1]], float),
    )
)
CAMERA = sj.Camera.look_at(
    jnp.asarray([20.0, 6.0, 78.0], float), jnp.zeros(3), fov=34.0, width=44, height=40
)


@pytest.fixture(scope="module")
def splats():
    """A ball, a smaller one before it that casts its shadow on it, and one so far behind it that
    nothing is seen of it.
    """
    cloud = joined(
        sphere(1400, 20.0, jitter=0.0),
        sphere(300, 6.0, (-8.0, 6.0, 30.0), jitter=0.0),
        sphere(500, 6.0, (-25.0, -7.0, -97.0), jitter=0.0),
    )
    return eqx.tree_at(
        lambda each: each.albedo,
        cloud,
        0.6 + 0.3 * jnp.sin(cloud.centers / 5),
        is_leaf=lambda leaf: leaf is None,
    )


def in_parts(splats, size):
    def parts():
        for begin in range(0, splats.count, size):
            yield jax.tree.map(lambda leaf: leaf[begin : begin + size], splats)  # noqa: B023

    return parts


def test_parts_make_the_picture_of_all_at_once(splats, monkeypatch):
    settings = sj.RenderSettings(shadows=SHADOWS)
    whole = sj.render(sj.Scene(splats, LIGHTS, MATERIAL), CAMERA, settings)
    build, built, done = ClusterTree.build, [], []
    counts = [300, 600, 900, 1200, 1500, 1800, 2100, 2200]
    monkeypatch.setattr(
        ClusterTree, "build", lambda *given: built.append(len(given[0])) or build(*given)
    )
    streamed = sj.render_streamed(
        in_parts(splats, 300),
        LIGHTS,
        MATERIAL,
        CAMERA,
        settings,
        lambda what, count: done.append((what, count)),
    )
    assert streamed.overflow == 0
    assert [count for what, count in done if what == "diffusion"] == counts
    assert [count for what, count in done if what == "looking"][:16] == 2 * counts
    assert len(built) < len(counts)  # nothing is in reach of the last ball, which is not seen
    found = apart(*({name: getattr(frame, name) for name in FIELDS} for frame in (whole, streamed)))
    assert max(found.values()) < ROUNDING, found
    for ours, theirs in zip(streamed.layers, whole.layers, strict=True):
        error = np.abs(ours - theirs)[np.asarray(whole.coverage) > 0] / np.max(theirs)
        assert np.quantile(error, 0.99) < LAYERS
        assert error.max() < RIMS


@pytest.mark.parametrize("size", [70, 2200])
def test_how_fine_the_splats_are_is_found_of_all(splats, size):
    """By it a layer is carried or handed over, here and in `render` alike."""
    areas = jnp.asarray(
        np.random.default_rng(3).permutation(np.geomspace(0.1, 10.0, splats.count)), float
    )
    splats = eqx.tree_at(lambda each: each.areas, splats, areas)
    fine = StreamStatistics.of(in_parts(splats, size)).fine
    assert fine == pytest.approx(np.quantile(np.asarray(areas, np.float64), FINEST), rel=1e-6)


def test_what_cannot_be_streamed_is_refused(splats):
    with pytest.raises(ValueError, match="DenseDiffuser"):
        sj.render_streamed(
            in_parts(splats, 500),
            LIGHTS,
            MATERIAL,
            CAMERA,
            sj.RenderSettings(diffuser=DenseDiffuser()),
        )
    with pytest.raises(ValueError, match="no splats"):
        sj.render_streamed(lambda: iter(()), LIGHTS, MATERIAL, CAMERA)
    parts = [jax.tree.map(lambda leaf, size=size: leaf[:size], splats) for size in (10, 20)]
    for others in ([parts[1], parts[0]], [parts[0]], [parts[0], parts[0], parts[0]]):
        each = iter([[parts[0], parts[0]], others])
        with pytest.raises(ValueError, match="must be the same each time"):
            sj.render_streamed(lambda each=each: iter(next(each)), LIGHTS, MATERIAL, CAMERA)
    with pytest.raises(ValueError, match="of one size"):
        sj.render_streamed(lambda: iter(parts), LIGHTS, MATERIAL, CAMERA)
