"""Materials as files: what is shipped, what comes back, what is refused."""

import runpy
import tomllib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_close, assert_refused

import splatjax as sj
from splatjax.io import (
    list_materials,
    load_material,
    load_mean_cosine,
    load_medium,
    load_profile,
    profiles_folder,
    save_material,
    spectrum_to_rgb,
    surface_and_source,
)
from splatjax.io._tables import Table
from splatjax.scattering import (
    AngularLaw,
    Dipole,
    Film,
    HalfSpace,
    Layer,
    LayeredMultipole,
    Medium,
    Projected,
    SingleScattering,
    Skin,
)

# The rest is the freedom of an optimum.
REPRODUCED = 1e-5

# Of totals in float32, of media that hardly absorb.
HELD = 6e-3

FITTED = tuple(name for name in list_materials() if name not in ("skin", "marble_gems"))
PIGMENTED = "skin_brown", "skin_dark", "skin_light"
GOOD_MEDIUM = '[medium]\nunit = "1/mm"\nsigma_a = [0.1]\nsigma_s_prime = [1.0]\neta = 1.3\n'
GOOD_FIT = '[fit]\nunit = "mm^2"\nvariances = [0.1, 2.0]\nweights = [[0.2], [0.3]]\n'


def test_jensens_and_narasimhans_media_skin_and_seven_made_up_are_shipped():
    jensen = (
        "apple chicken1 chicken2 cream ketchup marble potato skimmilk skin1 skin2 "
        "spectralon wholemilk"
    )
    narasimhan = """cappuccino_powder espresso lemon_tea_powder lowfat_chocolate_milk lowfat_milk
        lowfat_soy_milk reduced_milk
        regular_chocolate_milk regular_milk regular_soy_milk shampoo white_grapefruit_juice"""
    made_up = ["grape", "ivory", "jade", "leaf", "porcelain", "soap", "wax"]
    others = ["marble_gems", "skin", "skin_layers", *PIGMENTED, *made_up]
    assert list_materials() == tuple(sorted([*jensen.split(), *narasimhan.split(), *others]))


def test_coefficients_are_those_published(tmp_path):
    milk = load_medium("regular_milk")
    published = [[4.5513, 5.8294, 7.136], [0.0015333, 0.0046, 0.019933]]
    np.testing.assert_allclose([milk.sigma_s_prime, milk.sigma_a], published, rtol=1e-6)
    dermis = load_profile("skin_layers").layers[1]
    np.testing.assert_allclose(dermis.medium.sigma_s_prime, [3.2, 4.0, 4.6], rtol=1e-6)
    np.testing.assert_allclose(dermis.thickness, 2.0)
    path = tmp_path / "gray.toml"
    path.write_text(GOOD_MEDIUM.replace("[0.1]", "[0.1, 0.2]").replace("[1.0]", "[1, 2]"))
    np.testing.assert_allclose(load_medium(str(path)).eta, [1.3, 1.3], rtol=1e-6)


@pytest.mark.parametrize("name", list_materials())
def test_every_material_loads_and_has_its_source(dtype, name):
    material = load_material(name)
    published = name == "marble_gems"  # four Gaussians of its green channel
    count = 4 if published else 8 if name in ("cream", "spectralon") else 6
    assert material.gaussians.weights.shape == (count, 1 if published else 3)
    has_angles = name in FITTED and name != "skin_layers"
    assert has_angles == (material.angles is not None)
    assert (has_angles and name not in PIGMENTED) == (material.medium is not None)
    assert {leaf.dtype for leaf in jax.tree.leaves(material)} == {jnp.dtype(dtype)}
    text = (profiles_folder() / f"{name}.toml").read_text(encoding="utf-8")
    assert {"citation", "provenance"} <= tomllib.loads(text)["source"].keys()


def test_skin_is_as_published():
    skin = load_material("skin")
    np.testing.assert_allclose(skin.gaussians.total_reflectance(), 1.0, rtol=1e-6)
    mean_squared_radius = 2 * skin.gaussians.variances @ skin.gaussians.weights
    np.testing.assert_allclose(mean_squared_radius, [2.7657, 0.13626, 0.049544], rtol=1e-4)
    np.testing.assert_allclose(
        [skin.eta, skin.roughness, skin.specular], [1.4, 0.3, 0.18], rtol=1e-6
    )


@pytest.mark.parametrize("name", FITTED)
def test_shipped_weights_are_not_negative_and_sum_to_the_total_reflectance(name):
    material, profile = load_material(name), load_profile(name)
    if isinstance(profile, Dipole):
        profile = HalfSpace(profile.medium)
    elif isinstance(profile, Skin):
        profile = Projected(profile.profile(), spectrum_to_rgb(profile.wavelengths))
    assert np.all(material.gaussians.weights >= 0)
    np.testing.assert_allclose(material.total_reflectance(), profile.total_reflectance(), atol=HELD)


@pytest.mark.slow
@pytest.mark.parametrize("names", [["marble"], pytest.param(FITTED, marks=pytest.mark.long)])
def test_shipped_files_are_what_the_command_writes(names, tmp_path):
    """All in one test: they share what is compiled."""
    tool = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "make_profiles.py"))
    for name in names:
        tool["write"](name, tmp_path / f"{name}.toml")
        with jax.enable_x64(True):
            written, shipped = load_material(tmp_path / f"{name}.toml"), load_material(name)
        assert_close(written, shipped, rtol=REPRODUCED, atol=REPRODUCED)
        written, shipped = (
            tomllib.loads((folder / f"{name}.toml").read_text())
            for folder in (tmp_path, profiles_folder())
        )
        assert written["source"] == shipped["source"]


SLAB_MEDIUM = Medium([1 / 7, 0.2], [3.0, 5.0], [1.4, 1.5])
GROUND = Medium([0.0, 1 / 7], [1.0, 1e5], [1.3, 1.1])
PROFILES = {
    "classical dipole": Dipole(GROUND),
    "multipole of 3 layers": LayeredMultipole(
        [Film([0.1, 0.2]), Layer(SLAB_MEDIUM, 2 / 3), Layer(GROUND, np.inf)]
    ),
}


@pytest.mark.parametrize("model", PROFILES)
def test_a_saved_material_comes_back_bit_for_bit(tmp_path, model):
    import colour  # noqa: F401  It makes NumPy print six digits.

    gaussians = sj.SumOfGaussians([1e-5, 2 / 3], [[1 / 3, 1e-9], [0.1, -0.2]])
    once = SingleScattering(Medium([1 / 7, 0.2], 3.0, 1.4), [1 / 3, 1.0])
    profile, path = PROFILES[model], tmp_path / "a.toml"
    medium = profile.medium if isinstance(profile, Dipole) else None
    material = sj.Material(
        gaussians,
        *(1.37, 0.1, 1.0),
        angles=AngularLaw([[0.7, 1.3], [0.2, -0.4], [0.1, 0.1]]),
        single_scattering=once,
        medium=medium,
    )
    source, fit = {"citation": 'Me, "2024"'}, {"error": [0.1, 0.2], "count": 2}
    save_material(material, path, profile=profile, source=source, fit=fit, g=0.75)
    assert eqx.tree_equal((load_material(path), load_profile(path)), (material, profile))
    assert load_mean_cosine(path) == (0.0 if medium is None else 0.75)
    assert f'profile = "{model}, exact Fresnel moments"' in path.read_text()
    assert "\neta = 1.37\n" in path.read_text()  # the shortest number that is read back exactly


def test_what_is_saved_can_be_loaded(tmp_path):
    """Roughness as it is rendered."""
    for roughness, expected in ((0.0, 0.05), (1.5, 1.0)):
        material = sj.Material(sj.SumOfGaussians([1.0, 2.0], [0.1, 0.2]), roughness=roughness)
        save_material(material, tmp_path / "a.toml")
        np.testing.assert_allclose(load_material(tmp_path / "a.toml").roughness, expected)
    descending = sj.Material(sj.SumOfGaussians([2.0, 1.0], [0.1, 0.2]))
    assert_refused(lambda: save_material(descending, tmp_path / "a.toml"), "variances .* -1 ")


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("marble", "a = [0.0021", "a = [0.0022"),
        ("marble", "[angles]", "g = 0.5\n[angles]"),
        ("skin_layers", "thickness = 0.25", "thickness = 0.26"),
        ("skin_brown", "melanin = 0.1", "melanin = 0.11"),
    ],
)
def test_coefficients_that_were_edited_after_their_fit_are_reported(tmp_path, name, before, after):
    """In a file of every kind, unless it has no digest, and in a scene."""
    text = (profiles_folder() / f"{name}.toml").read_text(encoding="utf-8")
    path, own = tmp_path / "mine.toml", "coefficients_digest"
    path.write_text(text, encoding="utf-8")
    load_material(path)
    edited = text.replace(before, after, 1)
    path.write_text(edited, encoding="utf-8")
    with pytest.warns(UserWarning, match=r"mine\.toml has coefficients .*`splatjax fit \S*mine"):
        load_material(path)
    path.write_text(edited.replace(own, "note"), encoding="utf-8")
    load_material(path)
    entries = tomllib.loads(edited)
    with pytest.warns(UserWarning, match=r"a\.toml: \[material\] has coefficients"):
        load_material(Table(Path("a.toml"), "material", entries, entries))


@pytest.mark.parametrize(
    ("load", "name", "value"),
    [
        (load_material, "marbel", "marbel: .* did you mean 'marble'"),
        (load_material, "Skin", "Skin: .* did you mean 'skin'"),
        (load_material, "xyzzy", "xyzzy: .* known are apple, cappuccino_powder"),
        (load_profile, "stone.mtlx", r"stone.mtlx: .*\[openpbr\]"),
        (load_medium, "skin", r"skin.toml: has no \[medium\]"),
        (load_medium, "skin_layers", r"has no \[medium\], only its layers"),
    ],
)
def test_what_is_not_there(load, name, value):
    assert_refused(lambda: load(name), value)
    with pytest.raises(FileNotFoundError, match=r"none\.toml: there is no such file"):
        load(Path("none.toml"))


def layered(*tables: str) -> str:
    return "".join(f"[[layers]]\n{table}" for table in tables)


COLOR = '[medium]\nunit = "mm"\ncolor = [0.8, 0.3]\nmean_free_path = 0.5\neta = 1.4\ng = 0.5\n'


def test_a_medium_may_be_given_in_other_ways(tmp_path):
    path = tmp_path / "wax.toml"
    path.write_text(GOOD_MEDIUM.replace("1/mm", "1/cm").replace("_prime", "") + "g = 0.75\n")
    medium = load_medium(path)
    found = medium.sigma_a, medium.sigma_s_prime
    np.testing.assert_allclose(found, [[0.01], [0.025]], rtol=1e-6)
    assert load_mean_cosine(path) == 0.75
    path.write_text(COLOR)
    found = HalfSpace(load_medium(path), load_mean_cosine(path))
    np.testing.assert_allclose(found.color(), [0.8, 0.3], atol=5e-3)


SLAB = 'thickness = 2.0\nthickness_unit = "mm"\n' + GOOD_MEDIUM.removeprefix("[medium]\n").replace(
    "eta = 1.3", "eta = [1.3]"
)
NO_FIT = '[source]\ncitation = "none"\n'
BAD = [
    (layered(SLAB.replace("2.0", "0.1")), r"\[layers 1\].*at least 1 in every channel.*0\.11"),
    (layered(SLAB.replace("2.0", "-1")), r"\[layers 1\].*thickness .* -1$"),
    (layered(SLAB, SLAB.replace('"mm"', '"cm"')), r"\[layers 2\] thickness_unit .*'cm'"),
    (layered(SLAB + "g = 0.9\n"), r"\[layers 1\].* has g and sigma_s_prime"),
    (layered(SLAB.replace("2.0", "inf"), SLAB), r"\[\[layers\]\]: layer 1 of 2"),
    (layered(SLAB, "optical_depth = [0.1, 0.2]\n"), r"\[1, 2\] channels"),
    (layered("optical_depth = [-0.1]\n", SLAB), r"\[layers 1\].*optical_depth .* -0\.1 at"),
    (layered("optical_depth = [0.1]\n"), r"none of these 1"),
    (GOOD_MEDIUM + layered(SLAB), r"has \[medium\] and \[\[layers\]\]"),
    ("layers = 3\n", r"layers must be one table or more; it is 3"),
    (GOOD_MEDIUM.replace("[0.1]", "[-0.1]"), r"\[medium\].*sigma_a .* -0\.1 at"),
    (GOOD_MEDIUM.replace("[1.0]", "[0.0]"), r"\[medium\].*sigma_s_prime .* 0 at"),
    (GOOD_MEDIUM.replace("[1.0]", "[nan]"), r"\[medium\].*sigma_s_prime .* nan at"),
    (GOOD_MEDIUM.replace("[1.0]", '["1"]'), r"\[medium\] sigma_s_prime .*\['1'\]"),
    (GOOD_MEDIUM.replace("[1.0]", "[true]"), r"\[medium\] sigma_s_prime .*\[True\]"),
    (GOOD_MEDIUM.replace("[1.0]", "[1.0, 2.0]"), r"\[medium\].*sigma_s_prime .*\[2\].*= \[1\]"),
    (
        GOOD_MEDIUM.replace("_prime", ""),
        r"\[medium\] has sigma_a, sigma_s; give .* and g, or",
    ),
    (GOOD_MEDIUM + "color = 0.5\n", r"\[medium\] has color, sigma_a, sigma_s_prime; give"),
    (COLOR.replace("0.8", "1.8"), r"\[medium\].*color must be between .* 1.8"),
    (COLOR.replace('"mm"', '"1/mm"'), r"\[medium\] unit must be 'mm'; it is '1/mm'"),
    (GOOD_MEDIUM.replace("1/mm", "mm"), r"\[medium\] unit must be '1/mm' or '1/cm'; it is 'mm'"),
    (GOOD_MEDIUM.replace('unit = "1/mm"\n', ""), r"\[medium\] unit must be .*; it is missing"),
    (
        GOOD_MEDIUM.replace("eta = 1.3\n", "").replace("1/mm", "1/cn"),
        "unit .*; did you mean '1/cm'",
    ),
    (GOOD_MEDIUM.replace("eta = 1.3\n", ""), r"\[medium\] eta .* missing"),
    (GOOD_MEDIUM, r"has no \[fit\]"),
    (GOOD_MEDIUM.replace("eta", "=eta"), r"TOML file"),
    (NO_FIT, r"has no \[medium\], \[openpbr\], \[burley\], \[skin\], \[\[layers\]\] or \[fit\]"),
    ("medium = 3\n", r"\[medium\] must be a table; it is 3"),
    (GOOD_FIT + "[surfaces]\n", r"unknown entry 'surfaces'.*'surface'"),
    (GOOD_MEDIUM.replace("_a", "_A"), r"\[medium\] has an unknown entry 'sigma_A'.*'sigma_a'"),
    (GOOD_FIT.replace("0.1, 2.0", "2.0, 0.1"), r"\[fit\].* variances ascend.* -1\.9 at"),
    (GOOD_FIT.replace("0.1, 2.0", "0.0, 2.0"), r"\[fit\].*variances .* 0 at"),
    (GOOD_FIT.replace("mm^2", "mm"), r"\[fit\] unit .*'mm'"),
    (GOOD_FIT.replace("[[0.2], [0.3]]", "[[0.2]]"), r"\[fit\].*weights .*\[1, 1\].*= \[2, "),
    (GOOD_FIT.replace("[0.3]]", "0.3]"), r"\[fit\] weights .*\[\[0.2\], 0.3\]"),
    (GOOD_FIT.replace("[0.2]", "[inf]"), r"\[fit\].*weights .* inf at"),
    (
        GOOD_FIT
        + GOOD_MEDIUM.replace("medium", "single_scattering")
        .replace("[", "[1, ")
        .replace("[1, s", "[s"),
        r"single_scattering has 2 channels, .* has 1",
    ),
    (GOOD_FIT + "[surface]\nroughness = 1.5\n", r"\[surface\].*roughness .* 1\.5$"),
    (
        '[openpbr]\nunit = "mm"\nsubsurface_weight = 0.5\n',
        r"\[openpbr\] subsurface_weight must be 1",
    ),
    (
        '[openpbr]\nunit = "mm"\nsubsurface_radius = [1, 2]\n',
        r"\[openpbr\] subsurface_radius must be one number",
    ),
    ("[skin]\nmelanin = 2.0\n", r"\[skin\]: Skin.melanin must be between 0 and 1; got 2"),
    ("[skin]\nmelanine = 0.1\n", r"\[skin\] has an unknown entry 'melanine'; did you mean"),
    ("[skin]\nblood = [0.1, 0.2]\n", r"\[skin\] blood must be one number"),
    (
        '[openpbr]\nunit = "cm"\nsubsurface_color = 0.5\nsubsurface_radius = -0.2\n',
        r"mean_free_path.*-2",
    ),
    ('[burley]\nunit = "mm"\nalbedo = 0.5\n', r"\[burley\] has no length; .* radius"),
    ('[burley]\nunit = "mm"\nalbedo = 1.5\nradius = 2.0\n', r"\[burley\].*albedo .* 1\.5"),
]


@pytest.mark.parametrize(("text", "value"), BAD)
def test_a_bad_file_is_refused_by_table_entry_and_value(tmp_path, text, value):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"bad.toml: .*{value}") as raised:
        load_material(path)
    assert "\n" not in str(raised.value)


def test_the_subsurface_of_openpbr_comes_in_with_its_defaults_and_its_color_goes_out(tmp_path):
    path, color = tmp_path / "wax.toml", [0.05, 0.6, 0.98]
    text = f'[openpbr]\nunit = "cm"\nsubsurface_color = {color}\nsubsurface_radius = 0.2\n'
    text += "subsurface_scatter_anisotropy = 0.5\nspecular_weight = 0.7\nspecular_roughness = 0.4\n"
    path.write_text(text, encoding="utf-8")
    medium, g = load_medium(path), load_mean_cosine(path)
    assert g == 0.5
    np.testing.assert_allclose(medium.eta, 1.5)
    sigma_t = medium.sigma_a + medium.sigma_s_prime / (1 - g)
    np.testing.assert_allclose(1 / sigma_t, [2.0, 1.0, 0.5], rtol=1e-5)
    found, white = (
        HalfSpace(Medium(sigma_a, medium.sigma_s_prime, medium.eta), g * jnp.ones(3)).color()
        for sigma_a in (medium.sigma_a, 0 * medium.sigma_a)
    )
    np.testing.assert_allclose(found / white, color, rtol=1e-3)
    surface, _ = surface_and_source(path)
    np.testing.assert_allclose([surface["specular"], surface["roughness"]], [0.7, 0.16], rtol=1e-6)
    path.write_text(f"{text}[surface]\nroughness = 0.5\n", encoding="utf-8")
    assert surface_and_source(path)[0]["roughness"] == 0.5  # which takes precedence


@pytest.mark.parametrize(
    ("name", "length"),
    [
        ("scattering_distance", 0.2),
        ("diffuse_mean_free_path", 0.2 * (3.5 + 100 * 0.17**4)),
        ("mean_free_path", 0.2 * (1.85 - 0.5 + 7 * 0.3**3)),
        ("radius", 0.2 * 4 * np.pi * (1.9 - 0.5 + 3.5 * 0.3**2)),
    ],
)
def test_normalized_diffusion_of_others_comes_in_by_its_length(tmp_path, name, length):
    """Christensen and Burley 2015, of albedo 0.5 and `d` of 2 mm; and back from a file."""
    path = tmp_path / "other.toml"
    path.write_text(f'[burley]\nunit = "cm"\nalbedo = 0.5\n{name} = {length}\n')
    for _ in range(2):
        profile = load_profile(path)
        np.testing.assert_allclose(profile.length_scale(), 2.0, rtol=1e-5)
        np.testing.assert_allclose(profile.total_reflectance(), 0.5)
        material = sj.Material(sj.SumOfGaussians([1.0], [[0.5]]))
        save_material(material, path, profile=profile)
