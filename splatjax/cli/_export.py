"""`splatjax export`: a material in the terms of other renderers."""

from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

import splatjax as sj
from splatjax.io import save_exports

from ._options import check_output


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a material's Gaussians as JSON for other renderers.

    Each entry with formula, unit and source: GPU Gems weights, a kernel for separable subsurface
    scattering, Burley's d, the shape parameter of Unity's HDRP, Blender's radius.

    Example: splatjax export skin --output skin.json
    """

    #: Name of a material (`splatjax materials`), or path of a TOML file with a [fit].
    material: tyro.conf.Positional[str]
    #: JSON file to write.
    output: Path

    def run(self) -> None:
        """Load, write."""
        check_output(self.output, (".json",))
        with jax.enable_x64(True):
            save_exports(sj.load_material(self.material), self.output)
        print(self.output)
