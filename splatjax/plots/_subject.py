"""What a figure shows: splats under lights, before a camera."""

from dataclasses import dataclass, replace

import jax
import numpy as np
from matplotlib.figure import Figure

from splatjax.io import linear_to_srgb
from splatjax.render import RenderSettings, plan, render
from splatjax.scene import AbstractLight, Camera, Frame, Material, Scene, Splats
from splatjax.splatting import PerspectiveView


@dataclass(frozen=True)
class Subject:
    """Splats (mm) under lights, before a camera."""

    name: str
    splats: Splats
    lights: tuple[AbstractLight, ...]
    camera: Camera

    def scene(self, material: Material) -> Scene:
        """Give the scene; where the splats carry albedo, that alone gives the color."""
        return Scene(
            self.splats, self.lights, material if self.splats.albedo is None else material.white()
        )

    def scaled(self, factor: float) -> "Subject":
        """Give the same body, larger or smaller, before the same camera and lights at infinity."""
        camera = replace(self.camera, position=factor * self.camera.position)
        return replace(self, splats=self.splats.scaled(factor), camera=camera)

    def without_albedo(self) -> "Subject":
        """Give the same body without its map: a material then shows in its own color."""
        return replace(self, splats=replace(self.splats, albedo=None))

    def drawn(
        self, material: Material, settings: RenderSettings | None = None, *more: Camera
    ) -> list[Frame]:
        """Render before the camera, and before others of the same size; all with one plan.

        **Raises:** `ValueError` as `splatjax.render`.
        """
        settings = RenderSettings() if settings is None else settings
        scene, cameras = self.scene(material), [self.camera, *more]
        found = plan(scene, cameras, settings)
        return [jax.block_until_ready(render(scene, camera, settings, found)) for camera in cameras]

    def close_up(self, row: float, column: float, zoom: float) -> Camera:
        """Give a camera at the same place that looks at what lies at a part of the height and width
        of the body's outline.
        """
        view, splats = PerspectiveView.of(self.camera), self.splats
        x, y, depth = (np.asarray(each) for each in view.project(splats.centers.T))
        middle = x.min() + column * np.ptp(x), y.min() + row * np.ptp(y)
        near = np.hypot(x - middle[0], y - middle[1])
        front = np.where(near <= np.quantile(near, 0.002), depth, np.inf)
        target = splats.centers[int(np.argmin(front))]
        fov = float(np.degrees(2 * np.arctan(0.5 / (zoom * float(self.camera.focal_length)))))
        eye, width, height = self.camera.position, self.camera.width, self.camera.height
        return Camera.look_at(eye, target.astype(eye.dtype), fov=fov, width=width, height=height)


def picture_grid(
    rows: list[list[np.ndarray]],
    titles: list[str],
    names: list[str] | None = None,
    *,
    inches: float = 2.6,
    below: float = 0.0,
) -> Figure:
    r"""Lay out pictures of linear light, premultiplied, over black.

    **Arguments:**

    - `rows`: of pictures `[height, width, 3]`.
    - `titles`: of the columns.
    - `names`: of the rows.
    - `inches`: height of a picture.
    - `below`: inches of room that is left below, for what else the figure shows.
    """
    height, width = rows[0][0].shape[:2]
    figure = Figure(
        figsize=(inches * width / height * len(titles) + 0.3, inches * len(rows) + 0.35 + below),
        dpi=150,
    )
    top, bottom = 1 - 0.3 / figure.get_figheight(), (0.05 + below) / figure.get_figheight()
    left = 0.28 / figure.get_figwidth() if names else 0.01
    grid = figure.add_gridspec(
        len(rows),
        len(titles),
        left=left,
        right=0.995,
        top=top,
        bottom=bottom,
        wspace=0.02,
        hspace=0.02,
    )
    for i, line in enumerate(rows):
        for j, picture in enumerate(line):
            axes = figure.add_subplot(grid[i, j])
            axes.imshow(linear_to_srgb(np.asarray(picture, np.float64)), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            for edge in axes.spines.values():
                edge.set_visible(False)
            if i == 0:
                axes.set_title(titles[j], fontsize="small", pad=3)
            if j == 0 and names:
                axes.set_ylabel(names[i], fontsize="small", labelpad=2)
    return figure


def bright(pictures: list[np.ndarray], share: float = 0.995) -> float:
    """Give the factor that brings the brightest pixels of some pictures, but for a share of them,
    just to white.
    """
    values = np.concatenate([np.max(np.asarray(each), axis=-1).ravel() for each in pictures])
    return float(0.95 / np.quantile(values[values > 0], share))
