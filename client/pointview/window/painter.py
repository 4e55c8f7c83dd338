"""The renderer on a thread of its own, and how it is told of models and colour modes.

An OpenGL context belongs to one thread, and the window has one already: on its own thread the renderer's context is
always the current one. A frame waits for its picture there, never for data: all clouds of the cut are in memory.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from pointview.colouring import Colouring, available_modes
from pointview.render import Kind, open_backend
from pointview.render.picture import tint_starved
from pointview.render.seen import contrast_by_cell, pixels_by_cell

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from pointview.camera import Camera
    from pointview.refine import Cut
    from pointview.render import Backend, Frame

    from .mirror import Mirror
    from .settings import Settings

Result = TypeVar("Result")


class Painter:
    """Draws cuts of the model that is open, in the colours that are chosen.

    Attributes
    ----------
    colouring : Colouring or None
        The present mode; None before the first frame.
    ready : bool
        Whether the next frame is drawn as quickly as all later ones.
    """

    def __init__(self, kind: Kind, *, threads: int, wake: Callable[[], None] = lambda: None) -> None:
        self._kind, self._threads, self._wake = kind, threads, wake
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="paint")
        self._backend: Backend | None = None
        self._key: tuple[object, ...] = ()
        self._first: Future[None] | None = None
        self.ready = False
        self.colouring: Colouring | None = None

    @property
    def name(self) -> str:
        """What draws."""
        return "" if self._backend is None else self._backend.name

    def prepare(self, cut: Cut, mirror: Mirror, camera: Camera, settings: Settings) -> bool:
        """Draw for the first time without waiting; True once that is done.

        After an installation kernels are compiled at their first use, which takes seconds.
        """
        if self._first is None:
            here = replace(mirror, clouds=dict(mirror.clouds))  # the frame loop changes its own meanwhile
            self._first = self._thread.submit(self._try, cut, here, camera, settings)
            self._first.add_done_callback(lambda _: self._wake())
        elif not self.ready and self._first.done():
            self._first.result()
            self.ready = True
        return self.ready

    def draw(self, cut: Cut, mirror: Mirror, camera: Camera, settings: Settings) -> Frame:
        """Draw a cut of what the mirror holds."""
        return self._thread.submit(self._draw, cut, mirror, camera, settings).result()

    def run(self, work: Callable[[], Result]) -> Result:
        """Do other work on the painter's thread, and wait for it: kernels are loaded from disk at their first use."""
        return self._thread.submit(work).result()

    def close(self) -> None:
        """Give back the renderer's memory and contexts."""
        self._thread.submit(self._forget).result()
        self._thread.shutdown()

    def _try(self, cut: Cut, mirror: Mirror, camera: Camera, settings: Settings) -> None:
        frame = self._draw(cut, mirror, camera, settings)
        pixels_by_cell(frame.depth, cut, camera)
        contrast_by_cell(frame, cut, camera, reach=1.0)

    def _draw(self, cut: Cut, mirror: Mirror, camera: Camera, settings: Settings) -> Frame:
        backend, colouring = self._prepared(mirror, settings)
        return backend.draw(cut, lambda node: colouring.cloud(node, mirror.take(node)), camera, settings.style())

    def _prepared(self, mirror: Mirror, settings: Settings) -> tuple[Backend, Colouring]:
        """Return renderer and colours; made anew when model, build or mode changed."""
        modes = available_modes(mirror.header)
        mode = settings.mode if settings.mode in modes else modes[0]
        up = None if settings.up is None else "xyz".index(settings.up)
        key = (id(mirror.index), mirror.build, mode, 0 in mirror.clouds, up)
        if self._backend is None or self.colouring is None or key != self._key:
            self._forget()
            assert mirror.index is not None
            self.colouring = Colouring(mode, mirror.header, mirror.index, mirror.clouds.get(0), up=up)
            self._backend = open_backend(self._kind, self.colouring.header, threads=self._threads)
            self._key = key
        return self._backend, self.colouring

    def _forget(self) -> None:
        if self._backend is not None:
            self._backend.close()
        self._backend = None


def shown(frame: Frame, settings: Settings) -> NDArray[np.uint8]:
    """Pixels of a frame as the settings want them, (h, w, 3) uint8."""
    return tint_starved(frame) if settings.tint else frame.rgb
