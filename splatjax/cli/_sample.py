"""`splatjax sample`: from a mesh with its maps to splats."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import splatjax as sj

from ._mesh_maps import MeshMaps
from ._options import UpAxis, check_output
from ._report import note, stage


@dataclass(frozen=True, kw_only=True)
class Sample(MeshMaps):
    """Cover a mesh with splats that carry its maps, and write them as PLY, in mm.

    The mesh is a GLB, glTF, OBJ, PLY, STL or OFF file.

    Example: splatjax sample head.glb --albedo color.jpg --mm-per-unit 53 --count 683549 --output
    head.ply
    """

    #: The file of the mesh.
    mesh: tyro.conf.Positional[Path]
    #: Length of the file's unit, mm: 1000 for meters.
    mm_per_unit: float
    #: The PLY file to write.
    output: Path
    #: Number of splats.
    count: int = 200_000
    #: Another spread of the same quality.
    seed: int = 0
    #: Put splats on the surface that bends as the mesh's normals do; otherwise on its flat
    #: triangles.
    rounded: bool = True
    #: Upward axis of the file; splats have +y up.
    up: UpAxis = "y"
    #: Degrees: edges are hard where triangles differ by more, and the file has no normals or
    #: smooth ones.
    crease_angle: float = 40.0

    def run(self) -> None:
        """Read, sample, write."""
        check_output(self.output, (".ply",))
        with stage(f"sampling {self.mesh} with {self.count} splats"):
            splats = sj.sample_mesh(
                self.mesh,
                self.count,
                mm_per_unit=self.mm_per_unit,
                seed=self.seed,
                rounded=self.rounded,
                up=self.up,
                crease_angle=self.crease_angle,
                **self.worn(),
            )
        with stage(f"writing {self.output}"):
            sj.write_splats(self.output, splats)
        carried = [
            name
            for name in ("albedo", "specular", "roughness")
            if getattr(splats, name) is not None
        ]
        size = np.ptp(np.asarray(splats.centers), axis=0)
        area = float(splats.areas.sum())
        covered = (
            f"{splats.count} splats on {area:.4g} mm^2, with {', '.join(carried) or 'no maps'}"
        )
        note(
            f"{covered}; the body is {size[0]:.3g} mm wide, {size[1]:.3g} high and {size[2]:.3g} "
            "deep"
        )
        print(self.output)
