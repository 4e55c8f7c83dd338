"""One viewing session: what the parts hold together, a frame at a time. Knows no window."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pointview.camera import Camera
from pointview.urgency import Contrast

from .commands import obey
from .controls import Viewpoint, vertical_of
from .culling import STRIDE, Culling
from .feed import View
from .inputs import Inputs, Scene, moved
from .mirror import Mirror
from .painter import Painter, shown
from .quality import Quality, loaded_bytes
from .recorder import Recorder

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pointview.refine import Cut
    from pointview.render import Frame, Kind

    from .feed import Feed
    from .settings import Settings

REST = 0.25
"""Seconds without motion after which the camera rests and the picture may take longer."""

CONTRAST_EVERY = 0.2
"""Seconds between two looks at where the picture is most wrong."""

SHARE_EVERY = 0.5
"""Seconds between two looks at how much of the view is here."""

NOTICE = 8.0
"""Seconds that a notice is shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewerOptions:
    """What a session starts with.

    Parameters
    ----------
    backend : {"auto", "gl", "cpu"}
    threads : int
        Threads of the CPU backend.
    folder : Path
        Where pictures and paths go.
    view : dict, optional
        A VIEW.json object; the whole model if not given.
    """

    backend: Kind = "auto"
    threads: int = 1
    folder: Path = Path()
    view: dict[str, Any] | None = None


class Viewer:
    """The state of a session.

    Parameters
    ----------
    open_feed : callable
        Makes the feed of a path or address.
    wake : callable
        Told, on another thread, when there is something to draw at last.
    """

    def __init__(
        self,
        open_feed: Callable[[str], Feed],
        options: ViewerOptions,
        settings: Settings,
        *,
        wake: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.options, self.settings = options, settings
        self._open_feed, self._clock = open_feed, clock
        self.painter = Painter(options.backend, threads=options.threads, wake=wake)
        self.feed: Feed | None = None
        self.mirror = Mirror()
        self.quality = Quality.at(settings.tolerance)
        self.culling = Culling(clock)
        self.contrast: Contrast | None = None
        self.view: Viewpoint | None = None
        self.cut: Cut | None = None
        self.frame: Frame | None = None
        self.scene: Scene | None = None
        self.recorder: Recorder | None = None
        self.message = ""
        self.loaded = (0, 0)
        self.drawing = 0.0
        self.longest_handover = 0.0
        self.closing = False
        self._drawn: tuple[object, ...] = ()
        self._moved_at = self._share_at = self._turned_at = self._told_at = self._contrast_at = -1e9
        self._redraw = False
        self._errors: dict[str, int] = {}

    def open(self, target: str) -> None:
        """Show another model in place of the present one."""
        self._close_feed()
        self.mirror, self.view, self.cut, self.frame, self.scene = Mirror(), None, None, None, None
        self.contrast = None
        self.message, self._told_at, self.loaded, self._errors = "", -1e9, (0, 0), {}
        self.settings.up, self.settings.help = None, False
        self.feed = self._open_feed(target)

    def close(self) -> None:
        """Stop what was started."""
        self._close_feed()
        self.painter.close()

    def tell(self, text: str) -> None:
        """Show a notice for a while."""
        self.message, self._told_at = text, self._clock()

    @property
    def title(self) -> str:
        """Of the window."""
        return "pointstream" if self.feed is None else f"{self.feed.target} - pointstream"

    @property
    def up(self) -> str:
        """Name of the vertical axis."""
        if self.settings.up is not None:
            return self.settings.up
        return "y" if self.mirror.index is None or self.mirror.header.crs is None else "z"

    def toggle_recording(self) -> Recorder | None:
        """Start to record the path of the camera, or stop; return what was recorded."""
        recorder, self.recorder = self.recorder, None
        if recorder is None:
            self.recorder = Recorder(self._clock())
        elif self.view is not None:
            recorder.note(self._clock(), self.view.camera, last=True)
        return recorder

    @property
    def loading(self) -> bool:
        """Whether more of the view is to come."""
        return self.feed is not None and self.feed.wanting and self.loaded[0] < self.loaded[1]

    @property
    def turning(self) -> bool:
        """Whether the camera turned around its pivot just now, or got another."""
        return self._clock() - self._turned_at < 2 * REST

    @property
    def busy(self) -> bool:
        """Whether the next frame has something to do for sure."""
        at_rest = self.culling.settled and not self.culling.changed
        return self._redraw or not at_rest or self._clock() - self._moved_at < REST

    def advance(self, did: Inputs) -> NDArray[np.uint8] | None:
        """Take in a frame's input and what came; return the new picture, or None if it is the same."""
        now = self._clock()
        if now - self._told_at > NOTICE:
            self.message = ""
        obey(self, did)
        if self.feed is None:
            return None
        news = self.mirror.take_in(self.feed.news())
        if self.mirror.failure and now - self._told_at > NOTICE:
            self.message = self.mirror.failure  # what was told since comes first
        self._hear(self.feed)
        if self.mirror.index is None:
            return None
        self._place(did, now)
        assert self.view is not None
        if self.recorder is not None:
            self.recorder.note(now, self.view.camera)
        moving = now - self._moved_at < REST
        state = (self.view.camera, moving, *_look(self.settings))
        picture = None
        if news or self._redraw or self.culling.changed or state != self._drawn:
            picture = self._draw(moving=moving)
            self._drawn = () if picture is None else state
        elif self.cut is not None and self.frame is not None and not self.culling.settled:
            self.painter.run(partial(self.culling.look, self.cut, self.view.camera, self.frame))
        if now - self._share_at > SHARE_EVERY:
            self._share_at = now
            self.loaded = loaded_bytes(self.mirror, self.view.camera, self.settings, self.culling.hidden)
        return picture

    def _hear(self, feed: Feed) -> None:
        """Show what keeps data from coming, each time that it happens."""
        errors = () if feed.stats is None else feed.stats.errors
        counts = {error.text: error.count for error in errors}
        new = [text for text, count in counts.items() if count > self._errors.get(text, 0)]
        if new:
            self.tell(new[-1])
        self._errors = counts

    def _draw(self, *, moving: bool) -> NDArray[np.uint8] | None:
        assert self.view is not None
        camera, first = self.view.camera, self.frame is None
        start = self._clock()
        self.cut = self._refined(camera, moving=moving)
        if not self.painter.prepare(self.cut, self.mirror, camera, self.settings):
            self._redraw = False
            return None
        self.frame = self.painter.draw(self.cut, self.mirror, camera, self.settings)
        drew = partial(self.culling.drew, self.cut, camera, self.frame, seconds=self._clock() - start)
        if self.painter.run(drew):
            self.cut = self._refined(camera, moving=moving)  # with what shows up (LPC 4: the third pass)
            self.frame = self.painter.draw(self.cut, self.mirror, camera, self.settings)
        seconds = self.drawing = self._clock() - start
        self._look_at_contrast(camera)
        # What compiles or uploads says nothing about the next frame.
        settled = not first and self.frame.uploads * 4 <= self.frame.clouds
        self._redraw = settled and self.quality.took(seconds, self.settings, moving=moving)
        assert self.scene is not None
        self.scene = _seen(self.scene, self.frame, camera)
        return shown(self.frame, self.settings)

    def _look_at_contrast(self, camera: Camera) -> None:
        """Ask the picture where it is most wrong, now and then while something is missing."""
        now = self._clock()
        if self.contrast is None or self.cut is None or self.frame is None or self.mirror.index is None:
            return
        if len(self.cut.wants) and now - self._contrast_at > CONTRAST_EVERY:
            self._contrast_at = now
            look = partial(self.contrast.look, self.mirror.index, self.cut, camera, self.frame, stride=STRIDE)
            self.painter.run(look)

    def _refined(self, camera: Camera, *, moving: bool) -> Cut:
        """Compute the cut of a frame, and ask for what it wants."""
        assert self.feed is not None
        assert self.mirror.index is not None
        self.culling.prepare(self.mirror.index, wanted=self.settings.occlusion)
        nodes = self.mirror.index.header.nodes
        if self.contrast is None or len(self.contrast.shown) != nodes:
            self.contrast = Contrast(nodes)
        cut = self.quality.cut(
            self.mirror, camera, self.settings, self.culling.hidden, self.contrast.shown, moving=moving
        )
        view = View(
            camera=camera,
            tolerance=self.quality.tolerance,
            cull_backfaces=not self.settings.two_sided,
            hidden=self.culling.hidden,
            contrast=self.contrast.shown,
        )
        self.feed.ask(self.mirror.build, cut.asks, cut.nodes, view)
        return cut

    def _place(self, did: Inputs, now: float) -> None:
        """Move the camera; place it first where the model is new."""
        width, height = did.size
        vertical = vertical_of(z_up=self.up == "z")
        if self.view is None or self.scene is None or self.scene.vertical != vertical:
            home = self._home(width, height)
            self.view = Viewpoint.of(home)
            self.scene = Scene(
                bounds=self.mirror.header.bounds,
                vertical=vertical,
                home=home,
                depth=np.full((height, width), np.inf, dtype=np.float32),
                shot=home,
            )
        after = moved(self.view, did, self.scene, fly=self.settings.fly, speed=self.settings.speed)
        if after.camera != self.view.camera:
            self._moved_at = now
        if did.picked or (did.turned != (0.0, 0.0) and not self.settings.fly):
            self._turned_at = now
        self.view = after

    def _home(self, width: int, height: int) -> Camera:
        if self.options.view is not None and self.settings.up is None:
            return Camera.from_view(self.options.view, width=width, height=height)
        return Camera.frame_model(self.mirror.header, width=width, height=height, z_up=self.up == "z")

    def _close_feed(self) -> None:
        if self.feed is not None:
            self.feed.close()
            self.longest_handover = max(self.longest_handover, self.feed.longest_handover)
            self.feed = None


def _look(settings: Settings) -> tuple[object, ...]:
    """Return the settings that change the picture."""
    return (
        settings.tolerance, settings.limited and settings.budget, settings.steady and settings.frame_seconds,
        settings.mode, settings.tint, settings.occlusion, settings.up, settings.style(),
    )  # fmt: skip


def _seen(scene: Scene, frame: Frame, camera: Camera) -> Scene:
    return Scene(bounds=scene.bounds, vertical=scene.vertical, home=scene.home, depth=frame.depth, shot=camera)
