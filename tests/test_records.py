"""Records take numbers, lists and tuples, and convert them once; nonsense is refused by name, by
records and functions alike. The camera: directions, field of view, and views along up.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax.baselines import bust_with_textures

CENTERS = [[0, 0, 0], [1, 0, 0]]
NORMALS = ((0, 0, 1), (0, 0, 1))


def medium() -> sj.Medium:
    return sj.Medium([0.02, 0.006, 0.015], (1.1, 1.3, 1.5), eta=1.4)


def material() -> sj.Material:
    return sj.Material(sj.SumOfGaussians([0.1, 2], [[0.3, 0.3, 0.2], [0.5, 0.4, 0.2]]))


def splats(**fields) -> sj.Splats:
    return sj.Splats(
        **{"centers": CENTERS, "normals": NORMALS, "radii": 1, "areas": np.pi, **fields}
    )


def light() -> sj.DirectionalLight:
    return sj.DirectionalLight([0.5, -0.5, -1], irradiance=3.14)


def camera(eye=(66, 4, 140), target=(0, -9, 0), **more) -> sj.Camera:
    return sj.Camera.look_at(eye, target, **({"fov": 30, "width": 2, "height": 2} | more))


RECORDS = {
    "Medium": medium,
    "Layer": lambda: sj.Layer(medium(), 3),
    "Film": lambda: sj.Film(0.3),
    "Dipole": lambda: sj.Dipole(medium()),
    "Multipole": lambda: sj.scattering.Multipole(sj.Layer(medium(), 3), eta_above=1.2),
    "LayeredMultipole": lambda: sj.LayeredMultipole([sj.Film(0.1), sj.Layer(medium(), np.inf)]),
    "Burley": lambda: sj.scattering.Burley([0.8, 0.5], 1),
    "Tabulated": lambda: sj.scattering.Tabulated(
        [0, 1, 2], [3, 2, 1], deviation=(0.1, 0.1, 0.1), total=[1]
    ),
    "SingleScattering": lambda: sj.SingleScattering(medium()),
    "SumOfGaussians": lambda: sj.SumOfGaussians([0.1, 2], weights=[0.3, 0.5]),
    "Material": lambda: sj.Material(material().gaussians, eta=1, roughness=np.float64(0.5)),
    "Splats": lambda: splats(albedo=[[0.5, 0, 1]] * 2, roughness=1),
    "DirectionalLight": light,
    "PointLight": lambda: sj.PointLight((0, 0, 9), np.arange(3)),
    "SpotLight": lambda: sj.scene.SpotLight((0, 0, 9), [0, 0, -1], 2, 10),
    "GaussianBeam": lambda: sj.GaussianBeam([0, 0, 9], [0, 0, -1], power=1, variance=2),
    "Camera": camera,
    "Scene": lambda: sj.Scene(splats(), light(), material()),
    "Observation": lambda: sj.inverse.Observation(
        np.ones((2, 2, 3)), camera(), [light()], deviation=0.01
    ),
    "Candidate": lambda: sj.inverse.Candidate("front", camera(), light()),
    "GivenVariances": lambda: sj.fitting.GivenVariances((0.1, 2)),
}


@pytest.mark.parametrize("make", RECORDS.values(), ids=RECORDS)
def test_numbers_lists_and_tuples_become_strongly_typed_arrays(make):
    for leaf in jax.tree.leaves(make()):
        assert isinstance(leaf, jax.Array)
        assert not leaf.weak_type
        assert leaf.dtype in (jnp.result_type(float), jnp.bool_)


def test_a_number_stands_for_every_entry_of_an_axis_that_others_have():
    np.testing.assert_array_equal(medium().eta, jnp.full(3, 1.4))
    observation = sj.inverse.Observation(np.ones((2, 2, 3)), camera(), light(), deviation=1)
    scene = sj.Scene(splats(), light(), material())
    for field, shape in (
        (sj.scattering.Multipole(sj.Layer(medium(), 3)).eta_above, (3,)),
        (sj.SingleScattering(medium(), 0.5).strength, (3,)),
        (splats().radii, (2,)),
        (splats(specular=0.5).specular, (2,)),
        (sj.Medium(0.1, 1, 1.4).eta, (1,)),
        (sj.SumOfGaussians([0.1, 2], [0.3, 0.5]).weights, (2, 1)),
        (observation.deviation, (2, 2, 3)),
        (scene.lights[0].irradiance, (3,)),
    ):
        assert field.shape == shape
    assert isinstance(sj.Scene(splats(), [light(), light()], material()).lights, tuple)


def test_precision_follows_records_then_arrays_then_jax(x64):
    single = jnp.float32
    assert sj.Medium(np.ones(2, np.float32), [1, 1], 1.4).eta.dtype == single
    assert sj.Layer(sj.Medium(jnp.ones(2, single), 1, 1.4), 3.0).thickness.dtype == single
    assert sj.Film(np.float32(1)).optical_depth.dtype == jnp.result_type(float)
    with jax.enable_x64(True):
        assert sj.Medium(np.ones(2), np.ones(2, np.float32), 1.4).eta.dtype == jnp.float64
        assert sj.Medium(np.ones(2, np.float32), [1, 1], 1.4).eta.dtype == single


def test_traced_values_and_placeholders_pass_through_transformations():
    def eta(value):
        return sj.Medium([0.1, 0.2], 1.0, eta=value).eta

    np.testing.assert_array_equal(jax.jit(eta)(2.0), [2, 2])
    np.testing.assert_array_equal(jax.jacfwd(eta)(2.0), [1, 1])
    np.testing.assert_array_equal(jax.vmap(eta)(jnp.asarray([1.0, 2.0])), [[1, 1], [2, 2]])
    assert np.isnan(jax.jit(lambda x: sj.Medium(x, 1.0, 1.4).sigma_a)(jnp.nan))  # not checked
    array = jnp.ones(3)
    assert sj.Medium(array, array, array).eta is array
    shapes = jax.eval_shape(lambda: medium())
    assert sj.Medium(shapes.sigma_a, shapes.sigma_s_prime, shapes.eta).eta is shapes.eta
    assert jax.vmap(lambda _: medium())(jnp.zeros(4)).eta.shape == (4, 3)
    placeholder = object()
    assert eqx.tree_at(lambda one: one.eta, medium(), placeholder).eta is placeholder
    assert jax.tree.map(lambda _: placeholder, medium()).eta is placeholder


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: sj.scattering.Multipole(medium()),
            r"Multipole.layer must be Layer\(medium, thickness\)",
        ),
        (
            lambda: sj.LayeredMultipole([medium()]),
            r"LayeredMultipole.layers must be Layer.* or Film",
        ),
        (lambda: sj.Layer(1.0, 2.0), "Layer.medium must be Medium"),
        (lambda: sj.Scene(splats(), 3.0, material()), "Scene.lights must be AbstractLight"),
        (lambda: sj.Material(medium()), "Material.gaussians must be SumOfGaussians"),
        (lambda: sj.Medium("a", 1, 1), "Medium.sigma_a must be numbers"),
        (lambda: sj.Medium([[1, 2], [3]], 1, 1), "Medium.sigma_a must be numbers, in rows"),
        (
            lambda: sj.Medium([1, 2], [1, 2, 3], 1),
            r"Medium.sigma_s_prime has shape \[3\].* = \[2\]",
        ),
        (lambda: sj.SumOfGaussians([1, 2], [[1, 2, 3]]), r"weights has shape \[1, 3\]"),
        (
            lambda: sj.save_material(
                material(), "x.toml", profile=sj.scattering.Multipole(sj.Layer(medium(), 3))
            ),
            "profile must be a Dipole, .*LayeredMultipole.* got Multipole",
        ),
        (lambda: splats(normals=[[0, 0, 1]]), r"Splats.normals has shape \[1, 3\].* = \[2, 3\]"),
        (lambda: splats(radii=[1, 2, 3]), r"Splats.radii has shape \[3\]"),
        (lambda: splats(areas=[1]), r"Splats.areas has shape \[1\]"),
        (lambda: splats(albedo=[[1, 1, 1]]), r"Splats.albedo has shape \[1, 3\]"),
        (lambda: splats(centers=[0, 0, 1]), r"Splats.centers has shape \[3\]"),
        (lambda: sj.DirectionalLight([1, 0], 1), r"DirectionalLight.direction has shape \[2\]"),
        (lambda: splats(centers=[[0, 0, 0], [np.nan, 0, np.inf]]), "Splats.centers.*2 of 6"),
        (lambda: splats(normals=[[0, 0, np.nan]] * 2), "Splats.normals.*2 of 6"),
        (lambda: splats(radii=-1), "Splats.radii.*2 of 2"),
        (lambda: splats(areas=[np.inf, 1]), "Splats.areas.*1 of 2"),
        (lambda: splats(albedo=[[0, 1, 1.5], [0, np.nan, 1]]), r"albedo.*in \[0, 1\].*2 of 6.*1.5"),
        (lambda: sj.DirectionalLight([0, 0, 0], 1), "DirectionalLight.direction.*not zero"),
        (lambda: sj.GaussianBeam([0, 0, 0], [0, 0, 0], 1, 1), "GaussianBeam.direction"),
        (lambda: sj.GaussianBeam([0, 0, 0], [0, 0, 1], 1, 0), "GaussianBeam.variance"),
        (lambda: sj.PointLight([0, 0, np.inf], 1), "PointLight.position"),
        (lambda: sj.scene.SpotLight([0] * 3, [0, 0, 1], 1, 20, 20), "outer_angle .*larger.* 20"),
        (lambda: sj.scene.SpotLight([0] * 3, [0, 0, 1], 1, -1), "SpotLight.inner_angle .*-1"),
        (lambda: sj.DirectionalLight([1, 0, 0], [1, np.nan, 1]), "irradiance.*1 of 3"),
        (lambda: camera(fov=180.0), "fov"),
        (lambda: camera(width=0), "Camera.width must be at least 1 .* got 0"),
        (lambda: camera(height=-1), "Camera.height must be at least 1 .* got -1"),
        (lambda: sj.Camera([0, 0, 9], np.eye(3), 1, 24.5, 2), "Camera.width must .* got 24.5"),
        (
            lambda: sj.Camera([0, 0, 9], [[2, 0, 0], [0, 5, 0], [0, 0, 1]], 1, 2, 2),
            "Camera.rotation.* 3 at",
        ),
        (lambda: splats().scaled(np.nan), "scale must be positive; got nan"),
        (lambda: camera([0, 0, 1e25]), r"e\+2[45]"),
        (lambda: camera([0, 0, np.nan]), "nan"),
        (lambda: camera([1, 2, 3], [1, 2, 3]), "eye and target"),
        (lambda: camera([1, 2]), "eye, target and up"),
        (lambda: sj.Material(material().gaussians, roughness=-0.1), "Material.roughness"),
        (lambda: sj.Medium([-0.1], 1.0, 1.3), "Medium.sigma_a"),
        (lambda: sj.Medium([0.1, np.nan], 1.0, 1.3), "Medium.sigma_a"),
        (lambda: sj.Medium(0.1, 0.0, 1.3), "Medium.sigma_s_prime"),
        (lambda: sj.Medium(0.1, np.inf, 1.3), "Medium.sigma_s_prime"),
        (lambda: sj.Medium(0.1, 1.0, eta=0.0), "Medium.eta"),
        (lambda: sj.scattering.Burley(1.01, 1.0), "Burley.albedo"),
        (lambda: sj.scattering.Burley(-0.01, 1.0), "Burley.albedo"),
        (lambda: sj.scattering.Burley(0.5, 0.0), "Burley.free_path"),
        (lambda: sj.Film(-0.1), "Film.optical_depth"),
        (lambda: sj.Layer(medium(), -1), "Layer.thickness"),
        (lambda: sj.scattering.Tabulated([0, 1, 1], [1, 1, 1]), "steps of Tabulated.radii"),
        (lambda: sj.scattering.Tabulated([-1, 1], [1, 1]), "Tabulated.radii"),
        (lambda: sj.scattering.Tabulated([0, 1], [1.0, np.nan]), "Tabulated.values"),
        (lambda: sj.scattering.Tabulated([0, 1], [1.0]), "Tabulated.values"),
        (lambda: sj.scattering.Tabulated([0.0], [1.0]), "Tabulated.radii"),
        (lambda: sj.LayeredMultipole([sj.Film(0.0)]), "none of these 1"),
        (lambda: sj.LayeredMultipole([sj.Layer(medium(), np.inf)] * 2), "layer 1 of 2"),
        (lambda: sj.SumOfGaussians([0, 1], [1, 1]), "SumOfGaussians.variances"),
        (
            lambda: sj.inverse.Observation(np.ones((3, 2, 3)), camera(), light()),
            "picture has 3 x 2 pixels",
        ),
        (
            lambda: sj.inverse.Observation(np.ones((2, 2, 3)), camera(), light(), deviation=0),
            "deviation",
        ),
        (lambda: sj.scattering.Multipole(medium(), -1.0), "too many positional arguments"),
        (
            lambda: sj.scattering.Tabulated([0, 1], [1, 1]).without(
                sj.SingleScattering(sj.Medium(0.1, 0.9, 1.0))
            ),
            "infinite at r = 0",
        ),
        (
            lambda: sj.scattering.L2_QUADRATURE.beyond(0.0),
            r"cut must be between 0 and .* length scales; got 0",
        ),
        (lambda: sj.fit_gaussians(sj.Dipole(medium()), 0), r"count must be .* got 0"),
        (lambda: sj.fit_gaussians(sj.Dipole(medium()), -1), r"count must be .* got -1"),
        (lambda: sj.fit_gaussians(sj.Dipole(medium()), True), r"count must be .* got True"),
        (lambda: sj.io.dipole_starts()(medium(), 9), "count must be from 1 to 8.*got 9"),
        (
            lambda: sj.exports.separable_kernel(material().gaussians, 1),
            "samples must be odd and at least 3.*got 1",
        ),
        (
            lambda: sj.exports.separable_kernel(material().gaussians, 24),
            "samples must be odd and at least 3.*got 24",
        ),
        (
            lambda: sj.exports.separable_kernel(material().gaussians, reach=0.0),
            "reach must be positive",
        ),
        (
            lambda: sj.exports.data_sheet(sj.SumOfGaussians([1.0], [[0.5, 0.0]])),
            r"total_reflectance must be positive.* 0 at \[1\]",
        ),
        (
            lambda: sj.Material(sj.SumOfGaussians([1.0], [[0.5, 0.0]])).white(),
            r"total_reflectance must be positive.* 0 at \[1\]",
        ),
        (
            lambda: sj.inverse.Observation(np.ones((2, 2, 3), np.uint8), camera(), light()),
            r"Observation\.picture has integer dtype",
        ),
        (lambda: bust_with_textures(0), "texels is 0"),
        (
            lambda: sj.geometry.complete_splats(np.concatenate([np.eye(3)] * 4)),
            "3 points are too few",
        ),
        (lambda: sj.EnvironmentLight("studio"), r"image .*'studio'.*sj\.scene\.studio\(\)"),
        (
            lambda: sj.render(
                sj.Scene(splats(), sj.DirectionalLight([0, 0, -1], [1, 1]), material()), camera()
            ),
            r"lights\[0\] has 2 channels",
        ),
        (
            lambda: sj.Material(
                material().gaussians, single_scattering=sj.SingleScattering(sj.Medium([1, 1], 1, 1))
            ),
            r"Material\.single_scattering has 2 channels, .* has 3",
        ),
        (
            lambda: sj.LayeredMultipole(
                [sj.Film([0.1, 0.2]), sj.Layer(medium(), 3), sj.Layer(sj.Medium(1, 1, 1), 3)]
            ),
            r"layers have \[1, 2, 3\] channels",
        ),
        (
            lambda: sj.diffusion.ShapeDiffuser(error=0.0),
            "ShapeDiffuser.error must be .*0",
        ),
        (
            lambda: sj.diffusion.ShapeDiffuser(opening=-0.5),
            "ShapeDiffuser.opening must be .*-0.5",
        ),
        (lambda: sj.splatting.SplattingSettings(full_coverage=0.0), "full_coverage"),
        (lambda: sj.splatting.SplattingSettings(full_coverage=-1.0), "full_coverage"),
        (
            lambda: sj.splatting.ShadowSettings(pixels_per_spacing=0.0),
            "pixels_per_spacing.*positive",
        ),
        (
            lambda: sj.splatting.ShadowSettings(pixels_per_spacing=np.nan),
            "pixels_per_spacing.*positive",
        ),
        (lambda: sj.inverse.combined([]), "recoveries is empty"),
        (lambda: sj.inverse.HuberLoss(0.0), "bend must be positive"),
        (
            lambda: sj.inverse.LightStrengths(step=0.0),
            r"LightStrengths\.step must be positive; got 0",
        ),
    ],
)
def test_nonsense_is_refused_by_name_and_value(make, message):
    kind = TypeError if "positional" in message else ValueError
    with pytest.raises(kind, match=message):
        make()


EYE, TARGET = np.asarray([30.0, 20.0, 50.0]), np.asarray([1.0, -2.0, 3.0])


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: sj.render(splats(), camera()), "scene"),
        (lambda: sj.make_plan(splats(), camera()), "scenes"),
        (lambda: sj.make_plan(sj.Scene(splats(), light(), material()), splats()), "cameras"),
        (lambda: sj.fit_gaussians(medium()), "profile"),
        (lambda: sj.bust("large"), "count"),
        (lambda: sj.write_png("none/a.png", np.ones((4, 4, 3), np.uint8)), "picture"),
        (lambda: sj.write_png("none/a.png", np.ones((4, 4))), "picture"),
    ],
)
def test_an_object_of_another_kind_is_refused_by_name(make, name):
    """By splatjax, or by the type checker of the tests."""
    with pytest.raises((ValueError, TypeError), match=name):
        make()


def test_a_mask_has_no_channels():
    mask = np.ones((2, 2, 3), bool)
    with pytest.raises(ValueError, match=r"mask has 2 x 2 x 3 pixels"):
        sj.inverse.Observation(np.ones((2, 2, 3)), camera(), light(), mask)


def test_without_maps_the_material_alone_gives_the_surface():
    plain = sj.bust(50).without_maps()
    assert plain.albedo is plain.specular is plain.roughness is None


def test_it_looks_at_the_target_upright():
    camera = sj.Camera.look_at(EYE, TARGET, fov=40.0, width=300, height=100)
    right, down, forward = np.asarray(camera.rotation)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(camera.rotation), 1, rtol=1e-6)
    np.testing.assert_allclose(forward * np.linalg.norm(TARGET - EYE), TARGET - EYE, rtol=1e-5)
    assert abs(right[1]) < 1e-7
    assert down[1] < 0
    # The field of view is that of the height.
    np.testing.assert_allclose(2 * camera.focal_length * np.tan(np.radians(20)), 1, rtol=1e-6)
    traced = jax.jit(lambda eye: sj.Camera.look_at(eye, TARGET))(jnp.asarray(EYE))
    np.testing.assert_allclose(traced.rotation, camera.rotation, atol=1e-6)


@pytest.mark.parametrize("straight", [[0.0, -1.0, 0.0], [0.0, 7.0, 0.0]])
def test_a_view_along_up_needs_another_up(straight):
    with pytest.raises(ValueError, match=r"up is \[0.0, 1.0, 0.0\]"):
        sj.Camera.look_at(EYE, EYE + straight)
    assert np.all(np.isfinite(sj.Camera.look_at(EYE, EYE + straight, up=[0, 0, -1]).rotation))


@pytest.mark.parametrize("size", [1e-10, 1e12])
def test_any_distance_that_single_precision_can_square_is_a_view(size):
    assert np.all(np.isfinite(sj.Camera.look_at(size * EYE, [0, 0, 0]).rotation))


def test_small_records_show_their_numbers_and_large_ones_their_shapes():
    assert "0.006" in repr(medium())
    assert "centers=f" in repr(sj.bust(50))
    jax.jit(lambda m: repr(m) and m.eta)(medium())


@pytest.mark.parametrize("size", [np.int64(48), np.int32(48), 48])
def test_a_picture_may_be_as_large_as_a_number_of_numpy(size):
    assert type(sj.Camera(EYE, np.eye(3), 1.0, size, size).width) is int
    with pytest.raises(ValueError, match=r"Camera.width must be .* an int"):
        sj.Camera(EYE, np.eye(3), 1.0, 48.5, 48)


def test_a_camera_has_right_handed_axes():
    with pytest.raises(ValueError, match="right-handed"):
        sj.Camera(EYE, -np.eye(3), 1.0, 8, 8)
