"""Figure 8: half by texture-space diffusion, half by splats."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from splatjax.baselines import TexturedMesh, half_and_half, render_texture_space
from splatjax.io import srgb_to_linear
from splatjax.scene import Camera, Material

from ._subject import Subject, bright, picture_grid

_GAIN = 8.0
_FINER = 2  # samples of triangles along an edge of a pixel


def figure_8(
    subject: Subject, mesh: TexturedMesh, material: Material, *, gain: float = _GAIN
) -> Figure:
    r"""Draw a body half as triangles with texture-space diffusion and half as splats; beside it the
    difference of the wholes.

    One should not see the line between the halves.

    **Arguments:**

    - `subject`: the body as splats.
    - `mesh`: the same body as triangles, mm.
    - `material`: with its scattering.
    - `gain`: by how much differences are enlarged.

    **Returns:** a matplotlib `Figure`. The difference, splats less triangles, lies around middle
    gray.

    **Raises:** `ValueError` for a mesh and a subject of which one has a map of albedo and the other
    none.

    **Source:** Kim et al. 2010, Figure 8.
    """
    if (mesh.albedo is None) != (subject.splats.albedo is None):
        has, lacks = ("splats", "mesh") if mesh.albedo is None else ("mesh", "splats")
        raise ValueError(
            f"the {has} have a map of albedo, and the {lacks} none: make the splats from the mesh "
            "and its maps"
        )
    scene, camera = subject.scene(material), subject.camera
    fine = render_texture_space(mesh, scene.lights, scene.material, _finer(camera)).frame.beauty
    triangles = fine.reshape(camera.height, _FINER, camera.width, _FINER, -1).mean(axis=(1, 3))
    (frame,) = subject.drawn(material)
    factor = bright([np.asarray(frame.beauty)])
    found = half_and_half(factor * triangles, factor * frame.beauty, gain)
    difference = srgb_to_linear(np.asarray(found.difference, np.float64))
    titles = ["texture-space diffusion | splats", f"difference, enlarged {gain:g} times"]
    figure = picture_grid([[np.asarray(found.halves), difference]], titles, inches=4.2)
    figure.axes[0].axvline(camera.width / 2 - 0.5, color="0.9", linewidth=0.8, dashes=(4, 4))
    return figure


def _finer(camera: Camera) -> Camera:
    return replace(camera, width=_FINER * camera.width, height=_FINER * camera.height)
