"""`splatjax.inverse.recover` in the background of a page."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError

import jax
import jax.numpy as jnp

from splatjax.fitting import TransportModel
from splatjax.inverse import Observation, recover
from splatjax.scattering import Medium
from splatjax.scene import Material, Splats

from ._controls import Controls
from ._session import Session


class Search:
    r"""Recover the material of a session from pictures of its body, in a thread. `stop` ends the
    search after the current stage; `start` can then continue from the result.

    **Arguments:**

    - `observations`: the pictures, at least one.
    - `report`: called in the thread of the search, with a description of each stage and the best
      medium so far, and finally with the summary, or with an error and `None`.

    **Raises:** `ValueError` for a material without a medium.
    """

    def __init__(
        self,
        session: Session,
        observations: Sequence[Observation],
        report: Callable[[str, Medium | None], None],
    ):
        if not session.start.sigma_a:
            raise ValueError(
                "the material has no medium to start the search from; add [medium] with sigma_a "
                "and sigma_s_prime to its file"
            )
        self._session, self._observations, self._report = session, observations, report
        self._thread, self._stopped = threading.Thread(), threading.Event()

    def start(self, controls: Controls) -> None:
        """Search from the coefficients of a state, unless a search is already running."""
        if not self._thread.is_alive():
            self._stopped.clear()
            inputs = self._session.scene(controls).material, TransportModel(controls.g)
            self._thread = threading.Thread(target=self._run, args=inputs, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the search after its current stage."""
        self._stopped.set()

    def join(self) -> None:
        """Wait until the search has ended."""
        if self._thread.is_alive():
            self._thread.join()

    def _run(self, material: Material, model: TransportModel) -> None:
        def progress(stage: str, medium: Medium) -> None:
            if self._stopped.is_set():
                raise CancelledError
            self._report(stage, medium)

        body = self._session.own.splats
        # Without an albedo the coefficients determine the color.
        splats = Splats(body.centers, body.normals, body.radii, body.areas)
        try:
            with jax.enable_x64(True):
                surface = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), material)
                recovery = recover(
                    self._observations,
                    splats,
                    surface.medium,
                    surface=surface,
                    model=model,
                    progress=progress,
                )
                self._report(recovery.summary(), recovery.medium)
        except CancelledError:
            self._report("stopped", None)
        except Exception as error:
            self._report(f"{type(error).__name__}: {error}", None)
