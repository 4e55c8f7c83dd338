"""The access layer in a thread of its own: frames never wait for the network, nor the network for frames.

    frame loop                         feed's thread
    ask(wants, pinned)  ─ a slot ────▶ end_frame(latest wants), every `TICK`; what a moving camera will want next is
                                       found here too, where the link has time for it
    news()              ◀─ a deque ─── what came, what was dropped
    stats               ◀─ a slot ──── counters

Both hand-overs are single assignments and deque operations, which are atomic in Python: no lock that one side could
hold while the other waits, and no call that could reach a socket or a disk. Of wants only the latest counts. The time
that the frame loop spends in here is measured all the same (`longest_handover`).
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lpc.errors import LpcError
from pointlink.front import precise_loop
from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores import open_store
from pointview.lookahead import Lookahead
from pointview.refine import Cut, refine
from pointview.stream.network import open_link

from .mirror import Came, Failed, Gone, News, Opened

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from numpy.typing import NDArray

    from pointlink.profiles import Profile
    from pointstream.cache import Cache
    from pointstream.stats import LayerStats
    from pointview.camera import Camera

TICK = 1 / 60
"""Seconds between two looks at the wants."""

CLOSING_TICK = 0.1
"""Seconds between two looks at whether to stop."""

MOST_NEWS = 512
"""News that one frame takes in: a fast disk must not turn a frame into an upload of everything."""

LOOK_EVERY = 0.1
"""Seconds from one look ahead of a moving camera to the next: it takes time from the frame loop."""

REST = 0.25
"""Seconds without another camera after which it does not move."""

PATIENCE = 5.0
"""Seconds that closing waits for the thread."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """How a frame was refined, for views that follow it; parameters as of `pointview.refine.refine`."""

    camera: Camera
    tolerance: float
    cull_backfaces: bool
    hidden: NDArray[np.bool_] | None
    contrast: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class Ask:
    """What the latest frame wants and draws, its view, and when that was, seconds."""

    build: int
    wants: NDArray[np.int64]
    pinned: NDArray[np.int64]
    view: View | None
    at: float


class Feed:
    """What comes from one model.

    Parameters
    ----------
    target : str
        Path or address.
    cache : Cache, optional
    link : Profile, optional
        Put this link before the model.
    capacity : int
        Bytes of decoded clouds.
    wake : callable
        Told of every piece of news, on the feed's thread: a frame loop may sleep until then.

    Attributes
    ----------
    thread : int
        Identity of the feed's thread.
    longest_handover : float
        Longest time that a call from the frame loop took, seconds.
    """

    def __init__(
        self,
        target: str,
        *,
        cache: Cache | None = None,
        link: Profile | None = None,
        capacity: int = LayerOptions().capacity,
        wake: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.target, self._cache, self._link = target, cache, link
        self._options, self._wake, self._clock = LayerOptions(capacity=capacity), wake, clock
        self._news: deque[News] = deque()
        self._ask: Ask | None = None
        self._stats: LayerStats | None = None
        self._wanting = True
        self._closing = False
        self._lookahead = Lookahead()
        self._camera: Camera | None = None
        self._moved_at = self._look_at = 0.0
        self.longest_handover = 0.0
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self._thread.start()
        self.thread = self._thread.ident

    # What the frame loop calls.

    def ask(self, build: int, wants: NDArray[np.int64], pinned: NDArray[np.int64], view: View | None = None) -> None:
        """Replace what is wanted; where the frame's view is told, those that follow it are fetched ahead."""
        start = self._clock()
        self._ask = Ask(build, wants, pinned, view, start)
        self._handed_over(start)

    def news(self) -> list[News]:
        """Take the oldest news, `MOST_NEWS` at most."""
        start = self._clock()
        taken: list[News] = []
        with contextlib.suppress(IndexError):
            while len(taken) < MOST_NEWS:
                taken.append(self._news.popleft())
        self._handed_over(start)
        return taken

    @property
    def stats(self) -> LayerStats | None:
        """Counters as of the last tick; None until the model is open."""
        return self._stats

    @property
    def wanting(self) -> bool:
        """Whether anything that the last frame wanted can still come."""
        return self._wanting

    def close(self) -> None:
        """Stop the thread; the only call that waits for it."""
        self._closing = True
        self._thread.join(PATIENCE)

    def _handed_over(self, start: float) -> None:
        self.longest_handover = max(self.longest_handover, self._clock() - start)

    # What runs on the feed's thread.

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=precise_loop) as runner:
            try:
                runner.run(self._until_closed())
            except (LpcError, OSError) as error:
                self._news.append(Failed(" ".join(str(error).split())))
                self._wanting = False
                self._wake()

    async def _until_closed(self) -> None:
        """Feed until `close`, which may come while a host does not answer."""
        feeding = asyncio.ensure_future(self._feed())
        try:
            while not (self._closing or feeding.done()):
                await asyncio.wait([feeding], timeout=CLOSING_TICK)
            if feeding.done():
                feeding.result()
        finally:
            feeding.cancel()
            with contextlib.suppress(asyncio.CancelledError, LpcError, OSError):
                await feeding

    async def _feed(self) -> None:
        async with self._layer() as layer:
            posted: NDArray[np.bool_] = np.zeros(0, dtype=bool)
            build = 0
            while True:
                stats = layer.stats
                if stats.build != build:
                    build, posted = stats.build, np.zeros(layer.header.nodes, dtype=bool)
                    self._news.append(Opened(layer.index, build))
                    self._wake()
                ask = self._ask
                if ask is not None and ask.build == build:
                    layer.end_frame(ask.wants, pinned=ask.pinned)
                    self._look_ahead(layer, ask)
                posted = self._post(layer, posted)
                self._stats, self._wanting = stats, layer.wanting
                await asyncio.sleep(TICK)

    def _look_ahead(self, layer: AccessLayer, ask: Ask) -> None:
        """Fetch what a moving camera will want next, where the link has time for it."""
        now, view = self._clock(), ask.view
        if view is None:
            return
        if view.camera != self._camera:  # what came in meanwhile is asked for with the same one
            self._lookahead.note(ask.at, view.camera)
            self._camera, self._moved_at = view.camera, ask.at
        if now < self._look_at:
            return
        self._look_at = now + LOOK_EVERY

        def look(camera: Camera) -> Cut:
            return refine(
                layer.index,
                camera,
                view.tolerance,
                layer.resident,
                cull_backfaces=view.cull_backfaces,
                hidden=view.hidden,
                priority="error",
                contrast=view.contrast,
            )

        moves = now - self._moved_at < REST
        layer.prefetch(self._lookahead.nodes(look) if moves and layer.spare else [])

    @contextlib.asynccontextmanager
    async def _layer(self) -> AsyncIterator[AccessLayer]:
        async with AsyncExitStack() as stack:
            if self._link is None:
                store = open_store(self.target, clock=self._clock, cache=self._cache)
            else:
                store = (await stack.enter_async_context(open_link(self.target, self._link, "real")))()
            layer = await AccessLayer.open(store, options=self._options, clock=self._clock)
            stack.push_async_callback(layer.close)
            yield layer

    def _post(self, layer: AccessLayer, posted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Post what changed since `posted`; returns what is resident now."""
        resident = layer.resident.copy()
        changed = np.flatnonzero(resident != posted)
        if len(changed) == 0:
            return posted
        gone = changed[~resident[changed]]
        if len(gone):
            self._news.append(Gone(tuple(gone.tolist())))
        for node in changed[resident[changed]].tolist():
            self._news.append(Came(node, layer.take(node)))
        self._wake()
        return resident
