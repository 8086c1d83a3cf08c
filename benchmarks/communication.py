"""What devices that share a scene's splats send each other for a picture: the model of
docs/devices.md, and what a program does.

`python -m benchmarks.communication` prints the model for 1e9 splats on 64 devices.
"""

import dataclasses
import math
import re

PIXELS = 64  # of a tile
_OPS = "all-reduce", "all-gather", "reduce-scatter"
_BYTES = {"f32": 4, "f64": 8, "s32": 4, "u32": 4, "pred": 1}
_FOUND = re.compile(rf"= (.+?) ({'|'.join(_OPS)})(?:-start)?\(")
_ARRAY = re.compile(r"(\w+)\[([\d,]*)\]")


@dataclasses.dataclass(frozen=True)
class Traffic:
    """Bytes of the results of each kind of collective, on one device."""

    summed: float
    """Of all-reduce."""
    scattered: float
    """Of reduce-scatter: a share of what is summed."""
    gathered: float
    """Of all-gather."""

    def sent(self, devices: int) -> float:
        """Give the bytes that each device sends when they stand in a ring, which is the least."""
        return (
            2 * (devices - 1) / devices * self.summed
            + (devices - 1) * self.scattered
            + (devices - 1) / devices * self.gathered
        )


def counted(program: str) -> Traffic:
    """Count the collectives in the text of a compiled program; a loop's once."""
    totals = dict.fromkeys(_OPS, 0.0)
    for results, op in _FOUND.findall(program):
        for kind, sizes in _ARRAY.findall(results):
            totals[op] += _BYTES[kind] * math.prod(int(size) for size in sizes.split(",") if size)
    return Traffic(totals["all-reduce"], totals["reduce-scatter"], totals["all-gather"])


@dataclasses.dataclass(frozen=True)
class Picture:
    """What the traffic of a picture depends on; not on the number of splats but through the
    cells.
    """

    tiles: int
    """Of the picture."""
    shown: int
    """Tiles that show anything, rounded up to a share for each device."""
    places: int
    """The same, with those of the surface behind."""
    maps: tuple[int, ...]
    """Tiles of each shadow map."""
    attributes: int
    """Numbers that are blended per pixel."""
    channels: int
    gaussians: int
    lights: int
    singles: int
    """Layers that are gathered from single splats."""
    cells: int
    size: int = 4
    """Bytes of a number."""

    def traffic(self) -> Traffic:
        """Give the traffic of a picture, without gradients."""
        at_pixels = PIXELS * self.size
        # Limits of the front, its weights, and two limits of what lies behind; of a shadow map also
        # both surfaces' two sums.
        summed = at_pixels * (4 * self.tiles + 8 * sum(self.maps))
        scattered = at_pixels * self.shown * 2 * (self.attributes + 2)
        # Depth, position, normal, coverage; shadows; layers and how they are resolved; albedo,
        # irradiance, diffuse and specular.
        shaded = 8 + self.lights + self.gaussians * (self.channels + 1) + 4 * self.channels
        gathered = at_pixels * self.places * shaded
        if self.singles:
            gathered += at_pixels * self.places * 3
            scattered += at_pixels * self.places * self.singles * (self.channels + 1)
        # Area, centers, normals, energy; spread, opening, bending; first moments about centers and
        # about normals.
        summed += self.size * self.cells * (7 + self.channels + 3 + 6 * self.channels)
        return Traffic(summed, scattered, gathered)

    def sent(self, devices: int) -> float:
        """Give the bytes that each device sends for a picture."""
        found = self.traffic()
        return Traffic(found.summed, found.scattered / devices, found.gathered).sent(devices)


def main() -> None:
    """Print the model of a head of 1e9 splats at 2048 x 2048 in skin, on 64 devices that send 50
    GB/s.
    """
    devices, rate = 64, 50e9
    tiles = (2048 // 8) ** 2
    picture = Picture(
        tiles=tiles,
        shown=tiles // 2,
        places=tiles // 2 + tiles // 20,
        maps=((1024 // 8) ** 2,),
        attributes=14,
        channels=3,
        gaussians=6,
        lights=1,
        singles=0,
        cells=0,
    )
    for cells in (
        0,
        113_000_000,
    ):  # of skin's narrowest layer, 0.043 mm, on the bust's 209,443 mm^2
        found = dataclasses.replace(picture, cells=cells)
        sent = found.sent(devices)
        print(f"{cells:>11,} cells: {sent / 1e9:.2f} GB from each device, {sent / rate:.3f} s")


if __name__ == "__main__":
    main()
