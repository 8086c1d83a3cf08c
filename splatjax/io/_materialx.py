"""Writing of materials as MaterialX documents with OpenPBR surfaces."""

from pathlib import Path
from string import Template

import jax.numpy as jnp
import numpy as np

from splatjax.exports import openpbr_subsurface, plain_numbers
from splatjax.scene import Material

from ._files import StrPath, atomic_path, check_suffix, check_units, expect

_DOCUMENT = Template("""<?xml version='1.0' encoding='utf-8'?>
<materialx version="1.39" colorspace="lin_rec709">
  <open_pbr_surface name="openpbr" type="surfaceshader">
    $inputs
  </open_pbr_surface>
  <surfacematerial name="material" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="openpbr" />
  </surfacematerial>
</materialx>
""")


def save_materialx(
    path: StrPath, material: Material, *, mm_per_unit: float = 1.0, g: float = 0.0
) -> None:
    r"""Write a material as a MaterialX document with an OpenPBR surface, atomically.

    The color and the mean free path of the subsurface are computed from the material's
    coefficients, or from its Gaussians (`splatjax.exports.openpbr_subsurface`).
    `specular_roughness` is the square root of the material's roughness. The Gaussians are not
    stored.

    **Arguments:**

    - `material`: a material of one or three channels.
    - `mm_per_unit`: length of the unit of the other renderer's scene, mm.
    - `g`: mean cosine of the material's phase function (`load_mean_cosine`).

    **Raises:** `ValueError` for another suffix than `.mtlx` or number of channels; `OSError` if the
    file cannot be written.
    """
    check_suffix(path, ".mtlx")
    check_units(path, mm_per_unit)
    inputs = openpbr_inputs(path, material, mm_per_unit, g)
    lines = []
    for name, values in inputs.items():
        kind = "float" if len(values) == 1 else "color3"
        text = ", ".join(map(str, values))
        lines.append(f'<input name="{name}" type="{kind}" value="{text}" />')
    with atomic_path(Path(path)) as temporary:
        document = _DOCUMENT.substitute(inputs="\n    ".join(lines))
        temporary.write_text(document, encoding="utf-8")


def check_colors(path: StrPath, material: Material) -> None:
    """Raise `ValueError` for a material that is neither gray nor red, green and blue."""
    is_rgb = material.channels in (1, 3) and material.wavelengths is None
    kind = "channels" if material.wavelengths is None else "wavelengths"
    expect(is_rgb, path, f"the material has {material.channels} {kind}; give gray or RGB")


def openpbr_inputs(
    path: StrPath, material: Material, mm_per_unit: float, g: float
) -> dict[str, list[float]]:
    """Return the inputs of an OpenPBR surface, as one or three numbers each.

    **Raises:** `ValueError` for a material of another number of channels.
    """
    check_colors(path, material)
    inputs = openpbr_subsurface(material, g)
    inputs["subsurface_radius"] /= mm_per_unit
    inputs |= {
        "subsurface_weight": jnp.ones(()),
        "specular_weight": material.specular,
        "specular_ior": material.eta,
        "specular_roughness": jnp.sqrt(material.roughness),
    }
    sizes = {name: 3 if jnp.ndim(value) else 1 for name, value in inputs.items()}
    return {
        name: plain_numbers(np.broadcast_to(value, sizes[name])) for name, value in inputs.items()
    }
