"""The law that ties the halves together: a narrow beam on a flat sheet renders to the sum of
Gaussians.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SKIN_VARIANCES, camera_over, sheet, skin

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser
from splatjax.gaussians import gaussian
from splatjax.io import load_material

EXACT = sj.RenderSettings(diffuser=ClusterDiffuser(error=0.0))
MARBLE_VARIANCES = tuple(load_material("marble").gaussians.variances.tolist())
SLANTS = (0.0, 50.0)
PEAK_SHARE = 1e-3  # a layer is compared where it exceeds this share of its peak
BEAM_TOLERANCE = 0.01
WIDE_TOLERANCE = 0.03  # with clusters and nodes


def beam(splats: sj.Splats) -> jnp.ndarray:
    """Unit power into the splat at the origin."""
    at = int(jnp.argmin(jnp.sum(splats.centers**2, axis=1)))
    return jnp.zeros((splats.count, 1)).at[at].set(1 / splats.areas[at])


def positions(camera: sj.Camera) -> np.ndarray:
    """Where the camera's rays meet the plane z = 0."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    focal = float(camera.focal_length) * camera.height
    rays = np.stack(
        [(x - camera.width / 2) / focal, (y - camera.height / 2) / focal, np.ones_like(x)], -1
    )
    rays = rays @ np.asarray(camera.rotation, np.float64)
    eye = np.asarray(camera.position, np.float64)
    return eye + rays * (-eye[2] / rays[..., 2:])


def layer_error(variance: float, kind: str, slant: float) -> float:
    deviation = variance**0.5
    splats = sheet(deviation / 4, 8 * deviation, kind)
    material = sj.Material(sj.SumOfGaussians(jnp.asarray([variance], float), jnp.ones((1, 1))))
    scene = sj.Scene(splats, (), material)
    cameras = {each: camera_over(4 * deviation, 48, each) for each in SLANTS}
    camera, plan = (
        cameras[slant],
        sj.make_plan(scene, list(cameras.values()), EXACT),
    )  # one plan is one program
    layer = np.asarray(sj.diffuse_irradiance(scene, beam(splats), camera, EXACT, plan))[0, ..., 0]
    squared = np.sum(positions(camera)[..., :2] ** 2, axis=-1)
    truth = np.exp(-squared / (2 * variance)) / (2 * np.pi * variance)
    seen = truth > PEAK_SHARE * truth.max()
    assert seen.sum() > 500
    return float(np.max(np.abs(layer / truth - 1)[seen]))


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize("slant", SLANTS)
@pytest.mark.parametrize("kind", ["grid", "jittered", "graded"])
def test_a_beam_on_a_sheet_is_the_gaussian_of_each_layer(kind, slant):
    # scale invariance is tested below, so one variance stands for all of them here
    assert layer_error(1.99, kind, slant) < BEAM_TOLERANCE


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize("variance", sorted({*SKIN_VARIANCES, *MARBLE_VARIANCES}))
def test_every_layer_of_skin_and_marble_is_its_gaussian(variance):
    assert layer_error(variance, "jittered", 0.0) < BEAM_TOLERANCE


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
def test_the_sum_of_layers_is_the_profile():
    # wide enough that what the widest layer loses beyond the border does not come back in the
    # normalization
    splats = sheet(0.05, 10.5)
    material = sj.Material(skin())
    scene = sj.Scene(splats, (), material)
    camera = camera_over(2.0, 48)
    layers = sj.diffuse_irradiance(scene, jnp.tile(beam(splats), (1, 3)), camera, EXACT)
    total = np.asarray(jnp.sum(layers * material.gaussians.weights[:, None, None], axis=0))
    radius = np.sqrt(np.sum(positions(camera)[..., :2] ** 2, axis=-1))
    truth = np.asarray(material.gaussians(jnp.asarray(radius, float)))
    seen = truth > PEAK_SHARE * truth.max(axis=(0, 1))
    assert np.max(np.abs(total / truth - 1)[seen]) < BEAM_TOLERANCE


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize("name", ["skin", pytest.param("marble", marks=pytest.mark.long)])
def test_a_wide_beam_with_default_settings_is_the_widened_profile(name):
    material = load_material(name)
    half_width = 30.0
    splats = sheet(0.18, half_width)  # wide enough for marble's widest layer
    light = sj.GaussianBeam(
        jnp.asarray([0.0, 0.0, 10.0]), jnp.asarray([0.0, 0.0, -1.0]), jnp.ones(3), jnp.asarray(1.0)
    )
    scene = sj.Scene(
        splats, (light,), eqx.tree_at(lambda m: m.specular, material, jnp.asarray(0.0))
    )
    camera = camera_over(9.0, 144)
    frame = sj.render(scene, camera)
    exitance = np.pi * np.asarray(frame.diffuse)
    squared = np.sum(positions(camera)[..., :2] ** 2, axis=-1)
    variances = np.asarray(material.gaussians.variances, np.float64)
    weights = np.asarray(material.gaussians.weights, np.float64)
    kernels = np.stack(
        [
            np.asarray(gaussian(jnp.asarray(v + 1.0, float), jnp.asarray(squared, float)))
            for v in variances
        ],
        -1,
    )
    truth = kernels @ weights
    seen = truth > 1e-2 * truth.max(axis=(0, 1))
    assert np.max(np.abs(exitance / truth - 1)[seen]) < WIDE_TOLERANCE


@pytest.mark.parametrize(
    ("kind", "tolerance"), [("grid", 1e-3), ("graded", 1e-3), ("jittered", 5e-3)]
)
def test_the_splats_inside_a_sheet_are_a_partition_of_unity(kind, tolerance):
    variance = 1.0
    splats = sheet(0.25, 8.0, kind)
    inside = np.linalg.norm(np.asarray(splats.centers), axis=1) < 2
    points = splats.centers[np.flatnonzero(inside)[::7]]
    squared = jnp.sum((points[:, None] - splats.centers[None]) ** 2, axis=-1)
    sums = jnp.sum(splats.areas[None] * gaussian(jnp.asarray(variance), squared), axis=1)
    np.testing.assert_allclose(np.asarray(sums), 1.0, atol=tolerance)
