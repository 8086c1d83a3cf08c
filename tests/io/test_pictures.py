"""Frames in OpenEXR, pictures in PNG, and those that move. Maps of every kind of numbers, baked
where the texture coordinates of each format say.
"""

import dataclasses
import re
from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
import trimesh
from bodies import assert_refused
from pictures import write_picture
from PIL import Image
from writers import SQUARE, TRIANGLES, UVS, ramp, some_frame, square, write_ply, xyz

import splatjax as sj
from splatjax.io import (
    linear_to_srgb,
    read_exr,
    read_manifest,
    read_picture,
    sample_mesh,
    srgb_to_linear,
    write_animation,
    write_exr,
    write_png,
)
from splatjax.io._images import read_color, read_map
from splatjax.splatting import PerspectiveView


@pytest.mark.parametrize(("channels", "lights", "gaussians"), [(3, 2, 11), (1, 0, 1), (12, 1, 3)])
def test_frame_comes_back_bit_by_bit(tmp_path, channels, lights, gaussians):
    frame = some_frame(channels, gaussians, lights)
    write_exr(tmp_path / "frame.exr", jax.tree.map(lambda leaf: leaf.astype(float), frame))
    assert eqx.tree_equal(read_exr(tmp_path / "frame.exr"), frame)
    assert [file.name for file in tmp_path.iterdir()] == ["frame.exr"]


def test_other_readers_rebuild_diffuse_from_layers_and_header_alone(tmp_path):
    frame, variances, manifest = some_frame(), [0.1, 0.2, 0.4, 7.5], {"--width": 5, "splats": None}
    path = tmp_path / "frame.exr"
    write_exr(path, frame, variances=variances, manifest=manifest)
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
        planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    rebuilt = sum(header[f"splatjax.weights.{k}"] * planes[f"diffusion{k}"] for k in (1, 2, 3, 4))
    np.testing.assert_allclose(rebuilt, planes["diffuse"], rtol=1e-6)
    np.testing.assert_allclose(header["splatjax.variances"], variances, rtol=1e-7)
    np.testing.assert_allclose(np.ravel(header["chromaticities"])[:2], [0.64, 0.33], rtol=1e-6)
    assert all(plane.dtype == np.float32 for plane in planes.values())
    assert read_manifest(path) == manifest
    (tmp_path / "bad.exr").write_bytes(path.read_bytes().replace(b'"--width"', b'"--width '))
    assert_refused(lambda: read_manifest(tmp_path / "bad.exr"), r"bad\.exr: Expecting")
    names = oiio.ImageInput.open(str(path)).spec().channelnames
    assert {"R", "A", "Z", "position.X", "albedo.R", "shadow2.Y", "diffusion4.G"} <= {*names}
    # Nuke and Blender read `layer.channel`, and Blender only the channels R, G, B, A, X, Y, Z.
    assert all(re.fullmatch(r"(\w+\.)?[RGBAXYZ]", name) for name in names)
    layers = Counter(name.rpartition(".")[0] for name in names)
    counts = {"diffusion4": 3, "diffuse": 3, "shadow1": 1, "shadow2": 1}
    assert counts.items() <= layers.items()


def test_half_precision_but_for_lengths(tmp_path):
    frame = some_frame()
    frame = eqx.tree_at(lambda frame: frame.specular, frame, 1e6 * frame.specular)
    write_exr(tmp_path / "half.exr", frame, half=True)
    with OpenEXR.File(str(tmp_path / "half.exr")) as file:
        kinds = {name: channel.pixels.dtype for name, channel in file.channels().items()}
    single = {name.partition(".")[0] for name, kind in kinds.items() if kind != np.float16}
    assert single == {"Z", "position"}
    again = read_exr(tmp_path / "half.exr")
    np.testing.assert_allclose(again.diffuse, frame.diffuse, rtol=2**-11)
    np.testing.assert_array_equal(again.position, frame.position)
    assert float(again.specular.max()) == 65504
    assert not np.isnan(again.beauty).any()


def test_the_header_has_the_camera_as_renderman_defines_it(tmp_path):
    """Matrices of row vectors: camera coordinates are right, up and forward, and the corners of the
    picture are (0, 0) and (1, 1).
    """
    camera = sj.Camera.look_at([30.0, 40, 200], [1, -2, 3], fov=35, width=50, height=60)
    camera = dataclasses.replace(camera, principal_point=[0.4, 0.55])
    write_exr(tmp_path / "frame.exr", some_frame(height=60, width=50), camera=camera)
    with OpenEXR.File(str(tmp_path / "frame.exr")) as file:
        to_camera, to_picture = (file.header()[f"worldTo{name}"] for name in ("Camera", "NDC"))
    point = jnp.asarray([5.0, 7.0, -3.0])
    column, row, depth = map(float, PerspectiveView.of(camera).project(point))
    x, y, z, w = np.append(point, 1) @ to_camera
    focal = 60 * float(camera.focal_length)
    np.testing.assert_allclose([z, w], [depth, 1], rtol=1e-5)
    np.testing.assert_allclose([20 + focal * x / z, 33 - focal * y / z], [column, row], atol=1e-3)
    x, y, z, w = np.append(point, 1) @ to_picture
    np.testing.assert_allclose([50 * x / w, 60 * y / w], [column, row], atol=1e-3)
    assert 0 < z / w < 1


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("x", 2, r"4 x 3 pixels at \(2, 0\)"),
        ("full_width", 9, "picture of 9 x 3"),
        ("chromaticities", [0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767], "0.713"),
    ],
)
def test_cropped_pictures_and_other_primaries(tmp_path, name, value, fault):
    image = oiio.ImageBuf(oiio.ImageSpec(4, 3, 3, "float"))
    if name == "chromaticities":
        image.specmod().attribute(name, "float[8]", value)
    else:
        setattr(image.specmod(), name, value)
    image.write(str(tmp_path / "a.exr"))
    assert_refused(lambda: read_picture(tmp_path / "a.exr"), rf"a\.exr: .*{fault}")


ENCODED = {
    "color": ([[[0, 0.2158605, 1], [0.00215, 2, -1]]], [[[0, 128, 255], [7, 255, 0]]]),
    "gray": (np.ones((2, 3, 1)), np.full((2, 3), 255)),
    "alpha": ([[[0.5, 0.5, 0, 0.5], [0, 0, 0, 0]]], [[[255, 255, 0, 128], [0, 0, 0, 0]]]),
}


@pytest.mark.parametrize("name", ENCODED)
def test_png_encodes_for_the_display(tmp_path, name):
    """sRGB: linear 0.2159 is 128 of 255, 0.0021 is a 36th (the straight part), and exposure counts
    in stops.
    """
    picture, expected = (np.asarray(each) for each in ENCODED[name])
    write_png(tmp_path / "a.png", picture)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), expected)
    scale = [0.25] * 3 + [1] if name == "alpha" else 0.25
    write_png(tmp_path / "b.png", jnp.asarray(picture * scale), exposure=2.0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_notebook_shows_a_frame_as_png_writes_it(tmp_path):
    frame, spectral = some_frame(), some_frame(channels=12)
    write_png(tmp_path / "a.png", frame)
    assert frame._repr_png_() == (tmp_path / "a.png").read_bytes()
    for other in (spectral, jax.tree.map(lambda leaf: leaf[None], frame)):
        assert other._repr_png_() is None


def test_animation_keeps_the_colors_and_the_time(tmp_path):
    """Three frames of noise; the third ends at 125 ms."""
    pictures = np.random.default_rng(0).integers(0, 256, (3, 6, 5, 3), np.uint8)
    frames = [tmp_path / f"{i}.png" for i in range(3)]
    for path, picture in zip(frames, pictures, strict=True):
        Image.fromarray(picture).save(path)
    write_animation(tmp_path / "film.webp", frames, frames_per_second=24.0)
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (3, (5, 6), 0)
        for i, duration in enumerate((42, 41, 42)):
            film.seek(i)
            np.testing.assert_array_equal(np.asarray(film.convert("RGB")), pictures[i])
            assert film.info["duration"] == duration


SINGLE = 1e-6


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(
    ("suffix", "kind", "levels"),
    [
        ("png", "uint8", 255),
        ("png", "uint16", 65535),
        ("tif", "uint8", 255),
        ("tif", "uint16", 65535),
        ("tif", "float", None),
        ("exr", "float", None),
    ],
)
def test_pictures_of_every_kind_of_number(tmp_path, suffix, kind, levels, channels):
    """An albedo of whole numbers is sRGB, one of floats linear; other maps are not decoded."""
    shares = np.random.default_rng(channels).uniform(size=(5, 7, channels)).astype(np.float32)
    shares = np.rint(shares * levels) / levels if levels else shares.astype(float)
    path = write_picture(tmp_path / f"a.{suffix}", shares, kind)
    color = np.broadcast_to(shares[..., :3], (5, 7, 3))
    albedo = srgb_to_linear(color) if levels else color
    np.testing.assert_allclose(read_color(path), albedo, atol=SINGLE)
    np.testing.assert_allclose(read_map(path), color, atol=SINGLE)
    if levels is None:
        np.testing.assert_array_equal(read_picture(path), shares[..., : 3 if channels > 1 else 1])
    else:
        assert_refused(lambda: read_picture(path), rf"a\.{suffix}: is encoded for a display")


def test_decoding_is_that_of_colour_science():
    import colour

    encoded, linear = np.linspace(0, 1, 4097), np.linspace(-0.5, 1.5, 4097)
    np.testing.assert_allclose(
        srgb_to_linear(encoded), colour.cctf_decoding(encoded, function="sRGB"), atol=1e-15
    )
    np.testing.assert_allclose(
        linear_to_srgb(np.append(linear, np.nan)),
        colour.cctf_encoding(np.append(np.clip(linear, 0, 1), 0), function="sRGB"),
        atol=1e-15,
    )


@pytest.fixture
def folder(tmp_path):
    """The square with and without its texture, in formats that have v up and down."""
    ramp().save(tmp_path / "ramp.png")
    material = trimesh.visual.material.PBRMaterial
    plain, careless = square(material=material()), square(material=material())
    careless.visual.uv = careless.visual.uv * [1, -1] + [0, 1]
    for name, mesh, options in (
        ("careless.glb", careless, {}),
        ("square.glb", plain, {}),
        ("square.obj", plain, {"include_texture": True}),
        ("textured.glb", square(material=material(baseColorTexture=ramp())), {}),
        ("textured.obj", square(image=ramp()), {"mtl_name": "textured.mtl"}),
    ):
        mesh.export(tmp_path / name, **options)
    columns = xyz(SQUARE) | dict(zip("st", UVS.astype("f4").T, strict=True))
    faces = {"vertex_index": TRIANGLES.astype("i4")}
    wedges = faces | {"texcoord": UVS[TRIANGLES].reshape(2, 6).astype("f4")}
    for name, points, lists in (("textured", columns, faces), ("wedges", xyz(SQUARE), wedges)):
        write_ply(tmp_path / f"{name}.ply", points, lists, comments=["TextureFile ramp.png"])
    return tmp_path


@pytest.mark.parametrize(
    ("name", "v_up", "rises"),
    [
        ("square.obj", None, True),
        ("square.obj", True, True),
        ("square.obj", False, False),
        ("square.glb", None, True),
        ("square.glb", False, True),
        ("careless.glb", None, False),
        ("careless.glb", True, True),
        ("textured.glb", None, True),
        ("textured.obj", None, True),
        ("textured.ply", None, True),
        ("wedges.ply", None, True),
    ],
)
def test_maps_stand_upright(folder, name, v_up, rises):
    """Red, at the top of the picture, is at the top of the square; glTF has v down, others up, and
    a file may be careless.
    """
    albedo = None if name[0] in "tw" else folder / "ramp.png"
    splats = sample_mesh(folder / name, 300, mm_per_unit=5.0, albedo=albedo, v_up=v_up)
    height = np.asarray(splats.centers)[:, 1] / np.asarray(splats.centers)[:, 1].max()
    inner = np.abs(height - 0.5) < 0.48
    red = linear_to_srgb(np.asarray(splats.albedo, float)[:, 0])
    np.testing.assert_allclose(red[inner], (height if rises else 1 - height)[inner], atol=0.03)
    np.testing.assert_allclose(float(splats.areas.sum()), 100, rtol=1e-5)


def test_specular_and_normal_maps(folder):
    Image.fromarray(np.full((4, 4), 51, np.uint8)).save(folder / "specular.png")
    tilted = 255 * (np.asarray([0.6, 0.0, 0.8]) * 0.5 + 0.5) * np.ones((4, 4, 1))
    Image.fromarray(np.rint(tilted).astype(np.uint8)).save(folder / "normal.png")
    maps = {name: folder / f"{name}.png" for name in ("specular", "normal")}
    splats = sample_mesh(folder / "square.obj", 50, mm_per_unit=1.0, **maps)
    assert splats.albedo is None
    np.testing.assert_allclose(splats.specular, 0.2, rtol=1e-6)
    np.testing.assert_allclose(splats.normals, np.tile([0.6, 0, 0.8], (50, 1)), atol=2 / 255)


def tanned(melanin, blood) -> sj.SumOfGaussians:
    falls = np.asarray([[1.0, 2.0], [3.0, 2.0]]) * melanin + np.asarray([[5.0, 1.0]]) * blood
    return sj.SumOfGaussians([0.3, 2.0], [[0.4, 0.3], [0.5, 0.6]] * np.exp(-falls))


def test_weights_follow_maps_of_parameters(folder):
    """Melanin that grows upwards, and one blood for all."""
    nodes = {"melanin": np.geomspace(0.01, 0.4, 4), "blood": [0.01, 0.1]}
    table = sj.fitting.weight_table(tanned, nodes, tanned(0.01, 0.01))
    rising = 0.02 + 0.28 * (1 - (np.arange(64.0)[:, None] + 0.5) / 64) * np.ones(8)
    path = write_picture(folder / "melanin.exr", rising[..., None], "float")

    def weights(melanin, function=table.factors):
        parameters = {"melanin": melanin, "blood": 0.05}
        mesh, options = folder / "square.obj", {"parameters": parameters, "weights": function}
        splats = sample_mesh(mesh, 60, mm_per_unit=5.0, **options)
        return np.asarray(splats.centers)[:, 1] / 10, splats.weights

    height, found = weights(path)
    inner = np.abs(height - 0.5) < 0.49
    expected = table.factors({"melanin": 0.02 + 0.28 * height[inner], "blood": 0.05})
    np.testing.assert_allclose(found[inner], expected, rtol=1e-5)
    np.testing.assert_allclose(weights(rising)[1], found, rtol=1e-5)
    whole = (100 * rising).astype(np.uint8)  # looked up between its numbers, as others are
    hundredths = weights(
        whole, lambda values: table.factors(values | {"melanin": 0.01 * values["melanin"]})
    )
    np.testing.assert_allclose(hundredths[1], weights(whole * 0.01)[1], rtol=1e-5)
    one = table.factors({"melanin": np.full(60, 0.1), "blood": 0.05})
    np.testing.assert_allclose(weights(np.asarray(0.1))[1], one, rtol=1e-6)
    assert_refused(lambda: weights(np.ones((4, 4, 3))), r"melanin has shape \(4, 4, 3\)")
    assert_refused(lambda: weights(5 * rising), "square.obj: melanin must be between 0.01 and 0.4")
    assert_refused(lambda: weights(rising, None), "square.obj: .* give both")
