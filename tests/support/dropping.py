"""A window on which things are dropped, one after another, through the callback that glfw has for it.

``python -m support.dropping TARGET...`` prints a JSON list: what came of each drop, as title, message and splats. A
process of its own: see watched_session.
"""

from __future__ import annotations

import ctypes
import json
import sys
import time
from typing import Any

import glfw

from pointview.window.feed import Feed
from pointview.window.loop import run_loop
from pointview.window.screen import Screen
from pointview.window.settings import Settings
from pointview.window.viewer import Viewer, ViewerOptions

PATIENCE = 60.0
"""Seconds: for what happens at once unless the machine is busy."""


class Dropping(Screen):
    """A screen with somebody who waits for what comes of each drop."""

    def __init__(self, viewer: Viewer, targets: list[str]) -> None:
        super().__init__("dropping", (480, 320))
        self.viewer, self.targets, self.found = viewer, targets, list[dict[str, Any]]()
        self.dropped_at = -1.0
        self.on_drop: Any = glfw.set_drop_callback(self._window, None)  # gives back the one that was set

    def wait(self, *, busy: bool) -> None:
        """Look what came of the last drop, drop the next, close after the last."""
        viewer, now = self.viewer, time.monotonic()
        splats = 0 if viewer.frame is None else viewer.frame.splats
        if self.dropped_at > 0 and (viewer.message or splats or now > self.dropped_at + PATIENCE):
            self.found.append({"title": viewer.title, "message": viewer.message, "splats": splats})
            self.dropped_at = -1.0
        elif self.dropped_at < 0 and self.targets:
            viewer.message, viewer.frame, self.dropped_at = "", None, now
            self.on_drop(self._window, 1, (ctypes.c_char_p * 1)(self.targets.pop(0).encode()))
        elif self.dropped_at < 0:
            viewer.closing = True
        super().wait(busy=busy)


def main(targets: list[str]) -> None:
    viewer = Viewer(Feed, ViewerOptions(backend="cpu"), Settings(help=True))
    with Dropping(viewer, targets) as screen:
        try:
            run_loop(screen, viewer, seconds=4 * PATIENCE)
        finally:
            viewer.close()
    print(json.dumps(screen.found))


if __name__ == "__main__":
    main(sys.argv[1:])
