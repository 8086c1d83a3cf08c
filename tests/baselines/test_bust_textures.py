"""The bust with its colors in textures is the bust."""

import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.baselines import TexturedMesh, bust_with_textures, look_up
from splatjax.geometry import complexion


@pytest.fixture(scope="module")
def dressed():
    return bust_with_textures(512)


@pytest.mark.once
@pytest.mark.long
def test_its_face_has_the_colors_of_the_bust(dressed):
    mesh, textures = dressed
    triangles = TexturedMesh.of(mesh, textures)
    middles = mesh.corners().mean(axis=1)
    face = (middles[:, 2] > 40) & (np.abs(middles[:, 0]) < 50)  # what nothing overlaps
    uvs = jnp.asarray(mesh.uvs[face].mean(axis=1), float)
    found = np.asarray(look_up(triangles.albedo, uvs))
    expected, specular, roughness = complexion(middles[face])
    off = np.abs(found - expected).max(axis=1)
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.05
    assert np.std(expected[:, 0]) > 0.03
    for picture, values in ((triangles.specular, specular), (triangles.roughness, roughness)):
        assert np.median(np.abs(np.asarray(look_up(picture, uvs)).reshape(-1) - values)) < 0.02


def test_no_texels_are_refused():
    with pytest.raises(ValueError, match="texels is 0"):
        bust_with_textures(0)
