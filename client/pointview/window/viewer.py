"""One viewing session: what the parts hold together, a frame at a time. Knows no window."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from lpc.errors import LpcError
from pointview.camera import Camera
from pointview.colouring import MODES, available_modes
from pointview.render.picture import save_picture

from .controls import Viewpoint, vertical_of
from .culling import Culling
from .feed import View
from .inputs import Inputs, Scene, moved
from .mirror import Mirror
from .painter import Painter, shown
from .quality import Quality, loaded_bytes
from .recorder import Recorder, free_name
from .settings import TOLERANCES, Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from pointview.refine import Cut
    from pointview.render import Frame, Kind

    from .feed import Feed

REST = 0.25
"""Seconds without motion after which the camera rests and the picture may take longer."""

SHARE_EVERY = 0.5
"""Seconds between two looks at how much of the view is here."""

NOTICE = 8.0
"""Seconds that a notice is shown."""

SCANS = (".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".csv", ".txt", ".pts", ".ptx", ".obj")


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
        self._moved_at = self._share_at = self._turned_at = self._told_at = -1e9
        self._redraw = False

    def open(self, target: str) -> None:
        """Show another model in place of the present one."""
        self._close_feed()
        self.mirror, self.view, self.cut, self.frame, self.scene = Mirror(), None, None, None, None
        self.message, self.loaded = "", (0, 0)
        self.settings.up, self.settings.help = None, False
        self.feed = self._open_feed(target)

    def close(self) -> None:
        """Stop what was started."""
        self._close_feed()
        self.painter.close()

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

    @property
    def trouble(self) -> str:
        """What keeps data from coming, in a line; empty if nothing does."""
        stats = None if self.feed is None else self.feed.stats
        return stats.errors[0].text if stats is not None and stats.errors else ""

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
        if now - self._told_at > NOTICE and not self.mirror.failure:
            self.message = ""
        self._obey(did)
        if self.feed is None:
            return None
        news = self.mirror.take_in(self.feed.news())
        if self.mirror.failure:
            self.message = self.mirror.failure
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
        # What compiles or uploads says nothing about the next frame.
        settled = not first and self.frame.uploads * 4 <= self.frame.clouds
        self._redraw = settled and self.quality.took(seconds, self.settings, moving=moving)
        assert self.scene is not None
        self.scene = _seen(self.scene, self.frame, camera)
        return shown(self.frame, self.settings)

    def _refined(self, camera: Camera, *, moving: bool) -> Cut:
        """Compute the cut of a frame, and ask for what it wants."""
        assert self.feed is not None
        assert self.mirror.index is not None
        self.culling.prepare(self.mirror.index, wanted=self.settings.occlusion)
        cut = self.quality.cut(self.mirror, camera, self.settings, self.culling.hidden, moving=moving)
        view = View(
            camera=camera,
            tolerance=self.quality.tolerance,
            cull_backfaces=not self.settings.two_sided,
            hidden=self.culling.hidden,
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

    def _obey(self, did: Inputs) -> None:
        """Do what keys and drops command besides moving the camera."""
        settings = self.settings
        for target in map(tidied, did.dropped[:1]):
            if target.lower().endswith(SCANS):
                name = Path(target).name
                self._tell(f"{name} is a scan: make a model of it with `pointstream build {name} -o MODEL.lpc`")
            else:
                self.open(target)
        for key in did.pressed:
            if key == "c":
                modes = MODES if self.mirror.index is None else available_modes(self.mirror.header)
                at = modes.index(settings.mode) if settings.mode in modes else 0
                settings.mode = modes[(at + 1) % len(modes)]
            elif key == "t":
                settings.tint = not settings.tint
            elif key == "g":
                settings.fly = not settings.fly
            elif key == "b":
                settings.limited = not settings.limited
            elif key in ("[", "]"):
                finer = settings.tolerance * (0.8 if key == "[" else 1.25)
                settings.tolerance = min(max(finer, TOLERANCES[0]), TOLERANCES[1])
            elif key == "tab":
                settings.panel = not settings.panel
            elif key in ("f1", "?"):
                settings.help = not settings.help
            elif key == "escape":
                settings.help = False
            elif key in ("p", "f12"):
                self.save_picture()
            elif key == "r":
                self.toggle_recording()
            elif key == "u":
                settings.up = "z" if self.up == "y" else "y"
            elif key == "quit":
                self.closing = True

    def save_picture(self) -> None:
        """Write the picture without the panel to the first free name."""
        if self.frame is None:
            return
        path = free_name(self.options.folder, self._stem, ".png")
        self._try(lambda: save_picture(shown(self.frame, self.settings), path) if self.frame else None, path)

    def toggle_recording(self) -> None:
        """Start to record the path of the camera, or write what was recorded."""
        if self.recorder is None:
            self.recorder = Recorder(self._clock())
            return
        recorder, self.recorder = self.recorder, None
        if recorder.entries:
            path = free_name(self.options.folder, f"{self._stem}-path", ".json")
            self._try(lambda: recorder.write(path), path)

    @property
    def _stem(self) -> str:
        name = "" if self.feed is None else self.feed.target.rstrip("/").rpartition("/")[2].partition("?")[0]
        return Path(name).stem or "model"

    def _try(self, write: Callable[[], None], path: Path) -> None:
        try:
            write()
        except LpcError as error:
            self._tell(str(error))
        else:
            self._tell(f"written: {path}")

    def _tell(self, text: str) -> None:
        """Show a notice for a while."""
        self.message, self._told_at = text, self._clock()

    def _close_feed(self) -> None:
        if self.feed is not None:
            self.feed.close()
            self.longest_handover = max(self.longest_handover, self.feed.longest_handover)
            self.feed = None


def tidied(target: str) -> str:
    """Return the path or address in what was dropped or pasted: its first line, without quotes, of a file: address."""
    line = target.strip().partition("\n")[0].strip()
    if len(line) > 1 and line[0] == line[-1] and line[0] in "'\"":
        line = line[1:-1]
    if line.startswith("file://"):
        return unquote(line.removeprefix("file://").removeprefix("localhost"))
    return line


def _look(settings: Settings) -> tuple[object, ...]:
    """Return the settings that change the picture."""
    return (
        settings.tolerance, settings.limited and settings.budget, settings.steady and settings.frame_seconds,
        settings.mode, settings.tint, settings.occlusion, settings.up, settings.style(),
    )  # fmt: skip


def _seen(scene: Scene, frame: Frame, camera: Camera) -> Scene:
    return Scene(bounds=scene.bounds, vertical=scene.vertical, home=scene.home, depth=frame.depth, shot=camera)
