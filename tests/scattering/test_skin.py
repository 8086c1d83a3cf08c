"""Skin from its pigments: Monte Carlo, measured skin, the bands of hemoglobin, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax.scattering import Skin

# Percent reflected at 450, 500, 540, 580, 600, 650 and 700 nm, with the surface: 5th and 95th
# percentile of the International Skin Spectra Archive (Lu et al. 2025, Scientific Data,
# doi 10.1038/s41597-025-04857-5): foreheads of 353 Caucasians and 143 Africans.
MEASURED_AT = [450, 500, 540, 580, 600, 650, 700]
MEASURED = {
    "light": (
        [12.3, 17.0, 16.7, 18.4, 27.4, 35.7, 39.7],
        [27.2, 33.7, 33.2, 35.7, 47.5, 55.9, 57.9],
    ),
    "dark": ([4.8, 5.1, 5.5, 6.3, 7.1, 9.9, 14.2], [11.0, 15.1, 16.5, 19.5, 25.9, 33.3, 40.2]),
}
SKINS = {
    "light": {"melanin": 0.04, "blood": 0.015, "oxygenation": 0.6},
    "dark": {"melanin": 0.13, "blood": 0.01},
}
SURFACE = (0.4 / 2.4) ** 2  # what an index of 1.4 reflects along the normal


@pytest.mark.parametrize("name", SKINS)
def test_reflectance_lies_in_the_measured_range(name):
    skin = Skin(**SKINS[name], wavelengths=MEASURED_AT)
    reflected = SURFACE + (1 - SURFACE) * skin.half_space().total_reflectance()
    low, high = MEASURED[name]
    np.testing.assert_array_less(low, 100 * reflected)
    np.testing.assert_array_less(100 * reflected, high)


def test_hemoglobin_has_two_bands_with_oxygen_and_one_without():
    at = [530, 545, 560, 575, 590]
    full, empty = (
        np.asarray(Skin(0.02, 0.02, oxygenation, wavelengths=at).half_space().total_reflectance())
        for oxygenation in (1.0, 0.0)
    )
    assert full[1] < min(full[0], full[2])
    assert full[3] < min(full[2], full[4])
    assert np.argmin(empty) in (1, 2)


@pytest.mark.once
@pytest.mark.parametrize("name", SKINS)
def test_reflectance_and_profile_are_those_of_monte_carlo(name):
    """With an epidermis thinner than a mean free path."""
    skin = Skin(**SKINS[name], g=0.0, wavelengths=[450, 620])
    edges = np.asarray([0.0, 0.2, 0.5, 1.0, 2.0])
    walk = sj.transport.monte_carlo(skin.layers(), 20_000, jax.random.key(3), edges=edges)
    total = skin.half_space().total_reflectance()
    noise = 4 * walk.total_reflectance.deviation
    np.testing.assert_array_less(abs(total - walk.total_reflectance.value), 1e-3 + noise)
    radii = np.linspace(0, 2, 401)
    middle = jnp.asarray(0.5 * (radii[1:] + radii[:-1]), total.dtype)
    light = skin.profile()(middle) * (2 * np.pi * 0.005 * middle[:, None])
    rings = jnp.stack([jnp.sum(part, axis=0) for part in jnp.split(light, [40, 100, 200])])
    areas = np.pi * np.diff(edges**2)[:, None]
    counted, error = (areas * each for each in (walk.reflected.value, walk.reflected.deviation))
    allowed = 0.05 if name == "light" else 0.2
    np.testing.assert_array_less(
        abs(rings - counted), allowed * counted + 4 * error + 0.02 * total[None]
    )


def test_derivatives_are_differences(float64):
    names = ["melanin", "blood", "oxygenation", "eumelanin", "bilirubin", "thickness", "scattering"]
    names += ["carotene", "water", "vessel_radius", "scattering_power", "eta", "g"]
    at = [0.05, 0.03, 0.7, 0.6, 0.1, 0.07, 4.0, 1e-3, 0.6, 0.015, 1.3, 1.4, 0.7]

    @jax.jit
    def reflectance(values):
        fields = dict(zip(names, values, strict=True))
        profile = Skin(**fields, wavelengths=[450, 575]).profile()
        return jnp.sum(profile.total_reflectance() + profile(jnp.asarray([0.4]))[0])

    at = jnp.asarray(at)
    slopes = jax.jit(jax.grad(reflectance))(at)
    for i, slope in enumerate(slopes):
        step = 1e-4 * at * jnp.eye(len(names))[i]
        difference = (reflectance(at + step) - reflectance(at - step)) / (2 * step[i])
        np.testing.assert_allclose(slope, difference, rtol=1e-4, err_msg=names[i])


@pytest.mark.parametrize(
    ("field", "value"), [("melanin", 1.2), ("oxygenation", -0.1), ("wavelengths", [350, 500])]
)
def test_a_value_out_of_range_is_named(field, value):
    with pytest.raises(ValueError, match=f"Skin.{field} must be between"):
        Skin(**{field: value})
