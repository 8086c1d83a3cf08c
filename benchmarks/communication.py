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
class View:
    """The capacity of a picture, or of a shadow map, in tiles."""

    tiles: int
    front: int
    """Tiles with a surface in front that fit into a plan."""
    behind: int
    """Tiles in which a surface shows behind the front."""

    def limits(self) -> int:
        """Count the numbers that say where surfaces end: of the front, its weights, and two of what
        lies behind.
        """
        return PIXELS * (self.tiles + self.front + 2 * self.behind)

    @property
    def places(self) -> int:
        return self.front + self.behind


@dataclasses.dataclass(frozen=True)
class Picture:
    """What the traffic of a picture depends on."""

    camera: View
    maps: tuple[View, ...]
    """Of each light with shadows."""
    rows: int
    """Numbers that are blended per pixel, those of the layers among them."""
    channels: int
    gaussians: int
    lights: int
    splats: int
    size: int = 4
    """Bytes of a number."""

    def traffic(self) -> Traffic:
        """Compute the traffic of a picture, without gradients."""
        pixels = PIXELS * self.camera.places
        # Of a shadow map every device gets both surfaces' two sums.
        maps = sum(each.limits() + 2 * PIXELS * each.places for each in self.maps)
        # Depth, position, normal; weight, twice, and what lies before; shadows; layers and how far
        # they are resolved; albedo, irradiance, diffuse and specular.
        shaded = 10 + self.lights + self.gaussians * (self.channels + 1) + 4 * self.channels
        # Sources: center, normal, area and light.
        sources = self.splats * (7 + self.channels)
        return Traffic(
            summed=self.size * (self.camera.limits() + maps),
            scattered=self.size * pixels * (self.rows + 2),
            gathered=self.size * (pixels * shaded + sources),
        )

    def sent(self, devices: int) -> float:
        """Compute the bytes that each device sends for a picture."""
        found = self.traffic()
        return Traffic(found.summed, found.scattered / devices, found.gathered).sent(devices)


def main() -> None:
    """Print the model of a head of 1e9 splats at 2048 x 2048 in skin, on 64 devices that send 50
    GB/s.
    """
    devices, rate = 64, 50e9
    tiles = (2048 // 8) ** 2
    picture = Picture(
        camera=View(tiles, tiles // 2, tiles // 20),
        maps=(View(*[(1024 // 8) ** 2] * 3),),
        rows=17 + 6 * 16,
        channels=3,
        gaussians=6,
        lights=1,
        splats=0,
    )
    for splats in (0, 1_000_000_000):
        sent = dataclasses.replace(picture, splats=splats).sent(devices)
        print(f"{splats:>13,} sources: {sent / 1e9:.2f} GB from each device, {sent / rate:.3f} s")


if __name__ == "__main__":
    main()
