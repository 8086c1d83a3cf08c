"""The page of a studio in viser: sliders in front of the picture. A separate thread computes and
compiles, so that the page stays responsive.
"""

import io
import threading
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from splatjax._display import to_display
from splatjax._format import CHANNEL_COLORS
from splatjax._records import check_installed
from splatjax.inverse import Observation
from splatjax.scattering import Medium

from ._controls import LAYERS, Controls
from ._saving import SUFFIXES, AsFile
from ._search import Search
from ._session import Session
from ._sliders import coefficient_lines, sliders, values_of_medium
from ._viewer import Viewer

_NEAR = 1e-5  # relative difference of cameras that count as equal
_QUALITY = 92  # JPEG quality
_UNPICKED = "click the picture for the parts of a pixel"
_LEFT = 0.2  # fraction of the free width to the left of the picture; the controls are on the right


class Page(Viewer):
    """A session in a browser, or in the output of a notebook cell. All open pages show the same
    picture, from the camera that was moved last.

    **Arguments:**

    - `folder`: the only folder to which the page writes, under names that it chooses; created if
      missing.
    - `as_file`: see `save`.
    - `observations`: pictures of the body, the first with the camera and lights of the session.
      With them, the page can recover the material and shows the progress of the search.
    - `host`: the address to listen on; by default only this computer can open the page.
    - `port`: the port to listen on; if it is in use, the next free port.

    **Attributes:**

    - `url`: the address of the page.

    **Raises:** `ValueError` if viser is not installed.
    """

    def __init__(
        self,
        session: Session,
        folder: Path = Path("studio"),
        as_file: AsFile | None = None,
        *,
        observations: Sequence[Observation] = (),
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        check_installed("the page of the studio", "viser")
        import viser

        super().__init__(session, folder, as_file)
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file; give a folder for the files that the page saves")
        self._saves = list[tuple[str, Controls]]()
        self._observations = observations
        self._image, self._joined = Image.new("RGB", (1, 1)), list[Any]()
        self._changed, self._closed = threading.Event(), threading.Event()
        self._looking = threading.Lock()
        with redirect_stdout(io.StringIO()):  # viser prints its own address
            self._server = server = viser.ViserServer(host, port, "splatjax", verbose=False)
        # Viser could give the page a public address on a third-party server.
        server.request_share_url = lambda verbose=True: None
        self.url = f"http://{host}:{server.get_port()}"
        server.scene.set_up_direction("+y")
        camera = server.initial_camera
        camera.position, camera.look_at = self._place
        camera.fov = float(np.radians(session.fov))
        self._add_controls(server.gui)
        server.scene.on_click()(self._pick)
        server.on_client_connect(self._join)
        server.on_client_disconnect(
            lambda client: self._joined.remove(client) if client in self._joined else None
        )
        self._worker = threading.Thread(target=self._work, daemon=True)
        self._change()
        self._worker.start()

    def close(self) -> None:
        """Stop the server after the current computation."""
        if self._observations:
            self._search.stop()
            self._search.join()
        self._closed.set()
        self._change()
        self._worker.join()
        self._server.stop()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width: 100%; height: 600px; border: 0"></iframe>'

    def _add_controls(self, gui: Any) -> None:
        gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self._status = gui.add_markdown("starting ...")
        gui.add_button("first view").on_click(lambda _: self._look_again())
        gui.add_button_group("save", tuple(SUFFIXES)).on_click(
            lambda event: self._change(event.target.value)
        )
        self._add_sliders(gui)
        self._numbers, self._pixel = gui.add_markdown(""), gui.add_markdown(_UNPICKED)
        if self._observations:
            self._add_search(gui)
        self._add_plot(gui)

    def _add_sliders(self, gui: Any) -> None:
        self._handles["layer"] = gui.add_dropdown("layer", LAYERS)
        for folder, of_folder in sliders(self._session).items():
            is_open = folder == "skin"
            with gui.add_folder(folder, expand_by_default=is_open) if folder else nullcontext():
                for name, label, low, high, value, step in of_folder:
                    self._handles[name] = gui.add_slider(label, low, high, step, value)

        def moved(event: Any) -> None:
            handle = event.target
            if hasattr(handle, "min"):  # its box accepts any number
                handle.value = min(max(handle.value, handle.min), handle.max)
            self._change()

        for handle in self._handles.values():
            handle.on_update(moved)

    def _add_plot(self, gui: Any) -> None:
        """Add the plot of the profile and its fit."""
        radii, *_ = curves = self._session.curves(self._session.start)
        channels = self._session.own.material.channels
        profiles, hidden = len(curves) - 1 - channels, {"points": {"show": False}}
        series = [
            {"stroke": CHANNEL_COLORS[i % channels % 3] + opacity, "width": width, **hidden}
            for i in range(profiles + channels)
            for opacity, width in [("60", 6) if i < profiles else ("", 1.5)]
        ]
        self._plot = gui.add_uplot(
            tuple(curves),
            ({"label": "r"}, *series),
            title="r R(r) against r in mm, and its fit (narrow)",
            scales={"x": {"time": False, "distr": 3, "range": (float(radii[0]), float(radii[-1]))}},
            legend={"show": False},
            aspect=1.8,
        )

    def _add_search(self, gui: Any) -> None:
        self._search = Search(self._session, self._observations, self._follow)
        with gui.add_folder("material of the pictures"):
            buttons = gui.add_button_group("search", ("start", "stop"))
            self._stage = gui.add_markdown("")
            self._target = to_display(np.asarray(self._observations[0].picture))
            self._compared = gui.add_image(
                self._target, label="first picture; current minus first (gray: equal)"
            )

        def press(event: Any) -> None:
            if event.target.value == "start":
                self._search.start(self.controls)
            else:
                self._search.stop()

        buttons.on_click(press)

    def _follow(self, stage: str, medium: Medium | None) -> None:
        """Show a stage of the search, and set the sliders to its medium."""
        self._stage.content = f"```\n{stage}\n```"
        if medium is not None:
            for name, value in values_of_medium(self._session.start, medium).items():
                self._handles[name].value = value

    def _look_again(self) -> None:
        """Move the cameras of all pages to the first view."""
        for client in self._joined:
            client.camera.position, client.camera.look_at = self._first_place

    def _change(self, *saves: str) -> None:
        if saves:
            self._say("saving ...")
        self._saves += [(kind, self.controls) for kind in saves]
        self._changed.set()

    def _join(self, client: Any) -> None:
        client.camera.on_update(self._look)

    def _look(self, camera: Any) -> None:
        place = np.asarray([camera.position, camera.look_at])
        near = _NEAR * np.linalg.norm(place[0] - place[1])
        with self._looking:  # viser calls this method from several threads
            if camera.client not in self._joined:
                # Viser first sends its own cameras, then the initial camera of the page.
                if np.max(np.abs(place - self._first_place)) < near:
                    self._joined.append(camera.client)
                    camera.position, camera.look_at = self._place
                self._send(camera.client)
            elif np.max(np.abs(place - self._place)) > near:
                self._place = place
                self._change()
            else:  # the window may have another shape
                self._send(camera.client)

    def _pick(self, event: Any) -> None:
        """Choose the pixel that was clicked, or none outside the picture."""
        camera, (x, y) = self._session.camera(self._session.start), event.screen_pos
        width, height = _canvas(camera.width, camera.height, event.client)
        column, row = int(x * width - round(_LEFT * (width - camera.width))), int(y * height)
        is_inside = 0 <= column < camera.width and row < camera.height
        self._picked = (column, row) if is_inside else None
        self._pixel.content = f"pixel {column}, {row} ..." if is_inside else _UNPICKED
        self._change()

    def _say(self, text: str) -> None:
        self._status.content = text

    def _show(self, picture: np.ndarray) -> None:
        self._image = Image.fromarray(picture)
        for client in self._server.get_clients().values():
            self._send(client)

    def _show_pixel(self, rows: Sequence[Sequence[str]]) -> None:
        titles, *parts = rows
        lines = [" | ".join(row) for row in (titles, ["---"] * len(titles), *parts)]
        self._pixel.content = "\n".join(f"| {line} |" for line in lines) if parts else titles[0]

    def _send(self, client: Any) -> None:
        """Show the picture in a window of any shape, at the top and beside the controls."""
        size = _canvas(*self._image.size, client)
        canvas = np.asarray(ImageOps.pad(self._image, size, centering=(_LEFT, 0.0)))
        client.scene.set_background_image(canvas, "jpeg", jpeg_quality=_QUALITY)

    def _work(self) -> None:
        while not self._closed.is_set():
            self._changed.wait()
            self._changed.clear()
            self._report(self._update)

    def _update(self) -> str:
        """Show the current state, write the requested files, and return the status."""
        controls = self.controls
        self._show(self._session.draft(controls))
        self._plot.data = tuple(self._session.curves(controls))
        self._numbers.content = "  \n".join(coefficient_lines(controls))
        if not self._saves and self._changed.wait(self.still):
            return ""
        status = self._finish(controls)
        if self._observations and np.allclose(self._place, self._first_place, rtol=_NEAR):
            difference = 128 + (np.asarray(self._image, int) - self._target) // 2
            self._compared.image = np.hstack([self._target, difference.astype(np.uint8)])
        return self._save(self._saves) or status


def _canvas(width: int, height: int, client: Any) -> tuple[int, int]:
    """Compute the size of the smallest canvas that contains a picture and has the shape of the
    window.
    """
    aspect = client.camera.aspect
    return max(width, round(height * aspect)), max(height, round(width / aspect))
