"""A window on a model behind an ADSL line for some seconds, with every C function that the frame loop calls looked at.

``python -m support.watched_session MODEL SECONDS`` prints one JSON object. A process of its own: Mesa ends one that
opens a window after it has used OpenGL without one.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from typing import Any

from pointlink.profiles import ADSL
from pointview.window.feed import Feed
from pointview.window.loop import run_loop
from pointview.window.screen import Screen
from pointview.window.settings import Settings
from pointview.window.viewer import Viewer, ViewerOptions

BLOCKING = frozenset({
    "recv", "recv_into", "recvfrom", "send", "sendall", "sendmsg", "connect", "accept", "select", "poll", "epoll",
    "getaddrinfo", "pread", "preadv", "read", "readinto", "readline", "open", "openat", "fsync",
})  # fmt: skip


def main(model: str, seconds: float) -> None:
    blocked: list[str] = []
    calls = 0

    def look(_frame: Any, event: str, function: Any) -> None:
        nonlocal calls
        if event == "c_call":
            calls += 1
            if getattr(function, "__name__", "") in BLOCKING:
                blocked.append(repr(function))

    with Screen("session", (320, 240)) as window:
        viewer = Viewer(lambda target: Feed(target, link=ADSL), ViewerOptions(backend="cpu"), Settings(steady=False))
        try:
            viewer.open(model)
            sys.setprofile(look)  # of this thread, which is the frame loop's
            try:
                report = run_loop(window, viewer, seconds=seconds)
            finally:
                sys.setprofile(None)
        finally:
            viewer.close()
    print(json.dumps({"blocked": blocked, "calls": calls, **asdict(report)}))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
