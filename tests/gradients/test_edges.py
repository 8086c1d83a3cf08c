"""Gradients where things end: silhouettes against nothing and over a surface, edges of shadows. The
picture is smooth there.

Against central differences, and over a way as long as a pixel: what the gradients along it add up
to is what the picture does. That leaves little to the jumps that have no gradient, of fragments
that enter or leave the front surface.
"""

from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from worlds import FAST, uneven, view

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser

pytestmark = [pytest.mark.slow, pytest.mark.once]

SIZE = 32
AGREEMENT = 1e-3
OVER_A_PIXEL = 1e-2
STEP = 1e-4  # mm
POINTS = 16  # along a way
BALL = 4.5


@cache
def rendered():
    """A ball over a sheet that ends within the picture: a function of how far the ball, the sheet
    and the light are moved, which gives a weighed sum of beauty, the frame, and the gradient.

    All in one program: each takes its time to compile.
    """
    sheet = bodies.sheet(8.0, 1.2, center=(-2.7, 0.2, -6.0))
    body = uneven(bodies.joined(sheet, bodies.sphere(500, BALL, (1.0, 0.5, 4.0))))
    light = sj.DirectionalLight([-0.5, -0.3, -1.0], [2.0, 3.0])
    scene = sj.Scene(body, (light,), sj.Material(sj.SumOfGaussians([0.5], [[0.5, 0.3]])))
    camera = view((3.0, 2.0, 40.0), 30.0, SIZE)
    # The plain path gives the same digits here. A plan that holds while splats move by a pixel has
    # to look for neighbors far beyond the reach of the layer.
    settings = eqx.tree_at(lambda s: s.diffuser, FAST, ClusterDiffuser(margin=4.0))
    plan = sj.make_plan(scene, camera, settings)
    of_sheet = np.arange(body.count) < sheet.count
    ways = [
        jnp.asarray(which[:, None] * np.asarray([1.0, 0.3, 0.0])) for which in (~of_sheet, of_sheet)
    ]

    def summed(moved, share):
        centers = scene.splats.centers + moved[0] * ways[0] + moved[1] * ways[1]
        direction = scene.lights[0].direction + moved[2] * jnp.asarray([0.0, 1.0, 0.0])
        there = eqx.tree_at(
            lambda s: (s.splats.centers, s.lights[0].direction), scene, (centers, direction)
        )
        frame = sj.render(there, camera, settings, plan)
        return jnp.sum(share * frame.beauty), frame

    return jax.jit(jax.value_and_grad(summed, has_aux=True))


def edges(frame: sj.Frame) -> dict[str, np.ndarray]:
    """Where the picture shows what: by depth, coverage and shadow."""
    depth, coverage, shadow = (
        np.asarray(each) for each in (frame.depth, frame.coverage, frame.shadow[0])
    )
    front = np.where(np.isfinite(depth), depth, 0)
    steep = np.hypot(*np.gradient(front)) > 2
    inside = np.asarray(coverage) == 1
    outer = (coverage > 0) & (coverage < 1)
    far = front > 44  # the sheet
    inner = steep & inside & ~binary_dilation(coverage == 0, iterations=2)
    return {
        "outer": outer,
        "inner": inner,
        "shadow": (shadow > 0.05) & (shadow < 0.95) & far & ~steep & inside,
    }


# What is looked at, what moves (ball, sheet, light), and how far: a pixel is 0.67 mm at the ball;
# the shadow falls 10 mm deep.
CASES = {
    "outer-sheet": ("outer", 1, 0.67),
    "inner-ball": ("inner", 0, 0.67),
    "shadow-ball": ("shadow", 0, 0.67),
    "shadow-light": ("shadow", 2, 0.067),
}


@pytest.mark.parametrize("case", CASES)
def test_edges_move_as_their_gradient_says(case):
    where, which, far = CASES[case]
    with jax.enable_x64(True):
        found = rendered()
        (_, frame), _ = found(jnp.zeros(3), jnp.zeros((SIZE, SIZE, 2)))
        mask = edges(frame)[where]
        assert np.sum(mask) >= 15
        share = jnp.asarray(
            mask[..., None] * np.random.default_rng(1).uniform(-0.5, 1, (SIZE, SIZE, 2))
        )
        way = np.eye(3)[which]

        def at(t):
            (value, _), gradient = found(jnp.asarray(t * way), share)
            return float(value), float(gradient[which])

        start, slope = at(0.0)
        difference = (at(STEP)[0] - at(-STEP)[0]) / (2 * STEP)
        np.testing.assert_allclose(slope, difference, rtol=AGREEMENT)
        slopes = [at((i + 0.5) / POINTS * far)[1] for i in range(POINTS)]
        moved, followed = at(far)[0] - start, far * np.mean(slopes)
    print(
        f"{case}: gradient {slope:.6f}, differences {difference:.6f}; over a pixel {followed:.5f}, "
        f"picture {moved:.5f}"
    )
    assert abs(moved) > 0.01 * abs(start)
    assert abs(followed - moved) < OVER_A_PIXEL * far * np.mean(np.abs(slopes))
