"""Frame after frame until the window is closed, and what they took."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from .overlay import Overlay
from .panel import Panel

if TYPE_CHECKING:
    from collections.abc import Callable

    from .screen import Screen
    from .viewer import Viewer


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionReport:
    """The figures of a session.

    Parameters
    ----------
    frames, pictures : int
        Frames of the window, and those among them that drew the model anew.
    longest_frame_ms : float
        From collected input to the swapped buffers, but for the first picture, which compiles and loads.
    longest_beside_ms : float
        Longest time of a frame beside refining and drawing: input, news, panel, swap.
    first_picture_s : float or None
        Seconds from the start of the loop to the first samples on the screen.
    longest_handover_ms : float
        Longest time that a frame spent in asking the feed and taking its news: all that it has to do with network and
        disk, neither of which it can wait for (`feed`).
    splats, clouds, starved : int
        Of the last picture.
    bytes, requests : int
        Received by the feed of the last model.
    speculative_bytes, idle_bytes, wasted_bytes : int
        Those among them that were fetched ahead, that came while nothing was wanted, and that came ahead and no frame
        has drawn, as in the report of `stream`.
    backend : str
    """

    frames: int
    pictures: int
    longest_frame_ms: float
    longest_beside_ms: float
    first_picture_s: float | None
    longest_handover_ms: float
    splats: int
    clouds: int
    starved: int
    bytes: int
    requests: int
    speculative_bytes: int
    idle_bytes: int
    wasted_bytes: int
    backend: str


def run_loop(
    screen: Screen,
    viewer: Viewer,
    *,
    seconds: float | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> SessionReport:
    """Show a viewer on a screen.

    Parameters
    ----------
    seconds : float, optional
        Close by itself after that time.
    """
    panel = Panel()
    frames = pictures = 0
    longest, beside, first_picture = 0.0, 0.0, None
    start = clock()
    while not (screen.closing or viewer.closing):
        screen.wait(busy=viewer.busy)
        began = clock()
        inset = panel.inset(viewer.settings, screen.letters)
        did = screen.begin(inset)
        picture = viewer.advance(replace(did, pressed=did.pressed | panel.commands))
        if picture is not None:
            screen.show(picture)
            pictures += 1
        elif viewer.frame is None:
            screen.blank()
        screen.rename(viewer.title)
        panel.draw(viewer, screen.renderer)
        Overlay.beside(inset, panel.width(viewer.settings, screen.letters)).show(viewer)
        screen.end()
        ended = clock()
        frames += 1
        if first_picture is not None:
            longest = max(longest, ended - began)
            beside = max(beside, ended - began - (0.0 if picture is None else viewer.drawing))
        elif viewer.frame is not None and viewer.frame.clouds:
            first_picture = ended - start
        if seconds is not None and ended - start >= seconds:
            break
    stats = None if viewer.feed is None else viewer.feed.stats
    handover = max(viewer.longest_handover, 0.0 if viewer.feed is None else viewer.feed.longest_handover)
    return SessionReport(
        frames=frames,
        pictures=pictures,
        longest_frame_ms=round(1e3 * longest, 2),
        longest_beside_ms=round(1e3 * beside, 2),
        first_picture_s=None if first_picture is None else round(first_picture, 3),
        longest_handover_ms=round(1e3 * handover, 3),
        splats=0 if viewer.frame is None else viewer.frame.splats,
        clouds=0 if viewer.frame is None else viewer.frame.clouds,
        starved=0 if viewer.cut is None else int(viewer.cut.starved.sum()),
        bytes=0 if stats is None else stats.bytes_received,
        requests=0 if stats is None else stats.requests,
        speculative_bytes=0 if stats is None else stats.speculative_bytes,
        idle_bytes=0 if stats is None else stats.idle_bytes,
        wasted_bytes=0 if stats is None else stats.wasted_bytes,
        backend=viewer.painter.name,
    )
