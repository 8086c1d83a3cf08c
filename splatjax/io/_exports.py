"""Materials for other renderers, as JSON."""

import json
import os

from splatjax.exports import data_sheet
from splatjax.scene import Material

from ._atomic import atomic_path


def save_exports(material: Material, path: str | os.PathLike[str]) -> None:
    r"""Write a material's Gaussians in the terms of other renderers to a JSON file
    (`splatjax.exports.data_sheet`), whole or not at all.

    **Raises:** `ValueError` for a material with single scattering as a term of its own, which other
    renderers have no number for; `OSError` if the file cannot be written.
    """
    if material.single_scattering is not None:
        raise ValueError(
            f"{path}: the material has single scattering besides its Gaussians; fit it without, "
            "then export"
        )
    with atomic_path(path) as temporary:
        temporary.write_text(
            json.dumps(data_sheet(material.gaussians), indent=2) + "\n", encoding="utf-8"
        )
