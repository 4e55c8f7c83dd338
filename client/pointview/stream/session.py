"""One streaming run: frames on a clock, the access layer between them, and what each moment looked like.

The loop is the paper's (LPC 4): refine with what is resident, hand the wants to the access layer at the end of
the frame, draw. It never waits for data. Refinement runs every frame; pixels are made only at the moments that
the report shows, on an executor, so that a real clock is not held up and a virtual one does not notice.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import zstandard

from pointview.lookahead import Lookahead
from pointview.occlusion import KEPT, Occlusion
from pointview.refine import Cut, Priority, SplatRule, refine
from pointview.render import Kind, Style, open_backend
from pointview.urgency import Contrast

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.header import Header
    from pointstream.layer import AccessLayer
    from pointstream.stats import LayerStats
    from pointview.camera import Camera
    from pointview.render import Backend, Frame

Clock = Callable[[], float]

TEST_EVERY = 6
"""Frames from one look at what the picture shows to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionOptions:
    """What a run does.

    Parameters
    ----------
    seconds : float
        Length of the run, from opening the connection.
    tolerance : float
        Pixels.
    priority : {"index", "error"}
        Order of the wants.
    splat_rule : {"place", "paper"}
        What the size of a splat follows.
    occlusion : bool
        Leave out what is hidden, where that pays.
    prefetch : bool
        Fetch what a moving camera's next views will want where the link would idle.
    frame_interval : float
        Seconds between two frames.
    backend : {"auto", "gl", "cpu"}
    threads : int
        Threads of the CPU backend.
    style : Style
    """

    seconds: float
    tolerance: float = 1.0
    priority: Priority = "index"
    splat_rule: SplatRule = "place"
    occlusion: bool = True
    prefetch: bool = True
    frame_interval: float = 1.0 / 30.0
    backend: Kind = "auto"
    threads: int = 1
    style: Style = field(default_factory=Style)


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The state at one time of the run, and its picture.

    Parameters
    ----------
    t : float
        Seconds since the connection was opened.
    stats : LayerStats
    splats : int
    max_spacing_px : float
        Widest projected spacing at an end of the cut, pixels.
    camera : Camera
    size : (int, int)
        Height and width, pixels.
    packed : bytes
        The picture, compressed: a run holds some hundred of them.
    """

    t: float
    stats: LayerStats
    splats: int
    max_spacing_px: float
    camera: Camera
    size: tuple[int, int]
    packed: bytes

    @staticmethod
    def pack(frame: Frame) -> bytes:
        """Compress what a moment keeps of a frame: colours, and which pixels are covered and starved."""
        flags = ((frame.node >= 0) | (frame.starved.astype(np.uint8) << 1)).astype(np.uint8)
        return zstandard.compress(np.concatenate([frame.rgb, flags[..., None]], axis=2).tobytes(), 1)

    def picture(self) -> Picture:
        """Return the picture."""
        data = np.frombuffer(zstandard.decompress(self.packed), dtype=np.uint8).reshape(*self.size, 4)
        return Picture(rgb=data[..., :3], covered=data[..., 3] > 0, starved=data[..., 3] > 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """What a moment showed.

    Parameters
    ----------
    rgb : (h, w, 3) uint8
    covered, starved : (h, w) bool
        Pixels that show a sample, and one of a starved node.
    """

    rgb: NDArray[np.uint8]
    covered: NDArray[np.bool_]
    starved: NDArray[np.bool_]

    @property
    def starved_fraction(self) -> float:
        """Share of the covered pixels that are starved; 1 while nothing is covered."""
        covered = int(np.count_nonzero(self.covered))
        return int(np.count_nonzero(self.starved)) / covered if covered else 1.0


@dataclass(slots=True, kw_only=True)
class Recording:
    """What a run leaves behind.

    Parameters
    ----------
    moments : list of Moment
    stats : LayerStats
        At the end of the run.
    first_picture_s, settled_s : float or None
        Seconds to the first frame that shows samples, and to the first that misses nothing; None if never.
    frames : int
    longest_frame_s : float
        Longest time that one frame held the loop up; only a real clock sees any.
    samples : int
        Samples resident at the end: those that were received, unless the capacity of the layer was too small.
    occluded : int
        Branches that the last cut left out because they are hidden.
    left_out : dict of str to str
        What of the viewer's means paused at the end, and why.
    header : Header, optional
        Of the model that was there at the end.
    """

    moments: list[Moment] = field(default_factory=list)
    stats: LayerStats | None = None
    first_picture_s: float | None = None
    settled_s: float | None = None
    frames: int = 0
    longest_frame_s: float = 0.0
    samples: int = 0
    occluded: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    header: Header | None = None


def look_times(seconds: float) -> list[float]:
    """Moments worth a picture: every 0.1 s for two seconds, every 0.25 s up to five, every 0.5 s after, and the end."""
    times: set[float] = set()
    for start, stop, every in ((0.0, 2.0, 0.1), (2.0, 5.0, 0.25), (5.0, seconds, 0.5)):
        times |= {round(start + every * k, 3) for k in range(1, round((stop - start) / every) + 1)}
    return [*sorted(t for t in times if t < seconds - 1e-3), seconds]


def _nobody(_t: float) -> None:
    return None


async def record(
    opening: Awaitable[AccessLayer],
    camera_at: Callable[[Header, float], Camera],
    options: SessionOptions,
    clock: Clock,
    *,
    tell: Callable[[float], None] = _nobody,
) -> Recording:
    """Run one session.

    Parameters
    ----------
    opening : awaitable of AccessLayer
        Opens the connection when awaited; the times of the recording count from there. Closed at the end.
    camera_at : callable
        Camera for a time in seconds.
    options : SessionOptions
    clock : callable
        Monotonic seconds, of the running loop.
    tell : callable
        Told the time of the run in seconds at every frame.

    Raises
    ------
    StoreError, FormatError
        If the model cannot be opened.
    """
    start = clock()
    layer = await opening
    try:
        with ThreadPoolExecutor(1, thread_name_prefix="draw") as drawer:  # one thread: GL contexts stay on theirs
            return await _Session(layer, camera_at, options, clock, start, drawer, tell).run()
    finally:
        await layer.close()


class _Session:
    """The state of one run."""

    def __init__(
        self,
        layer: AccessLayer,
        camera_at: Callable[[Header, float], Camera],
        options: SessionOptions,
        clock: Clock,
        start: float,
        drawer: ThreadPoolExecutor,
        tell: Callable[[float], None],
    ) -> None:
        self.layer, self.camera_at, self.options = layer, camera_at, options
        self.clock, self.start, self.drawer, self.tell = clock, start, drawer, tell
        self.recording = Recording()
        self.lookahead = Lookahead()
        self.occlusion: Occlusion | None = None
        self.contrast: Contrast | None = None
        self.tested: tuple[object, ...] = ()
        self.steady = 0

    async def run(self) -> Recording:
        options, recording, clock = self.options, self.recording, self.clock
        loop = asyncio.get_running_loop()
        backend = await loop.run_in_executor(
            self.drawer, lambda: open_backend(options.backend, self.layer.header, threads=options.threads)
        )
        try:
            due = [self.start + t for t in look_times(options.seconds)]
            next_frame = clock()
            while True:
                now = clock()
                cut, camera = self._frame(now - self.start)
                self.tell(now - self.start)
                if now >= due[0]:
                    due = [t for t in due if t > now]
                    if not due:
                        self._take_stock()  # before the last picture: more arrives while it is drawn
                    stats = self.layer.stats  # more arrives while the picture is drawn
                    cut, frame = await self._draw(backend, cut, camera)
                    recording.moments.append(self._moment(cut, camera, frame, now - self.start, stats))
                    if not due:
                        return recording
                elif self._is_test_due(cut, camera):
                    await self._draw(backend, cut, camera)
                recording.longest_frame_s = max(recording.longest_frame_s, clock() - now)
                # A frame lands exactly on the next moment to look at, so that the report's times are the asked ones.
                next_frame = min([next_frame + options.frame_interval, *due[:1]])
                next_frame = max(next_frame, clock())
                await asyncio.sleep(0)
                while (early := next_frame - clock()) > 0:  # noqa: ASYNC110 - a timer may fire a clock tick too soon
                    await asyncio.sleep(early)
        finally:
            await loop.run_in_executor(self.drawer, backend.close)

    def _frame(self, t: float) -> tuple[Cut, Camera]:
        """Refine and ask: what every frame does, drawn or not."""
        layer, recording = self.layer, self.recording
        camera = self.camera_at(layer.header, t)
        cut = self._refine(camera)
        layer.end_frame(cut.asks, pinned=cut.nodes)
        if self.options.prefetch:
            self.lookahead.note(t, camera)
            layer.prefetch(self.lookahead.nodes(self._refine) if layer.spare else [])
        recording.frames += 1
        if len(cut.nodes):
            if recording.first_picture_s is None:
                recording.first_picture_s = t
            if recording.settled_s is None and not len(cut.wants):
                recording.settled_s = t
        return cut, camera

    def _take_stock(self) -> None:
        """Note what the whole run brought."""
        layer, recording = self.layer, self.recording
        recording.stats, recording.header = layer.stats, layer.header
        recording.samples = int(layer.index.samples[layer.resident].sum())

    def _refine(self, camera: Camera) -> Cut:
        layer, options = self.layer, self.options
        nodes = layer.header.nodes
        if not options.occlusion or options.splat_rule != "place":
            self.occlusion = None
        elif self.occlusion is None or len(self.occlusion.hidden) != nodes:
            self.occlusion = Occlusion(nodes)
        if options.priority != "error" or options.splat_rule != "place":
            self.contrast = None
        elif self.contrast is None or len(self.contrast.shown) != nodes:
            self.contrast = Contrast(nodes)
        return refine(
            layer.index,
            camera,
            options.tolerance,
            layer.resident,
            priority=options.priority,
            splat_rule=options.splat_rule,
            cull_backfaces=not options.style.two_sided,
            hidden=None if self.occlusion is None else self.occlusion.hidden,
            contrast=None if self.contrast is None else self.contrast.shown,
        )

    def _is_test_due(self, cut: Cut, camera: Camera) -> bool:
        """Tell whether the picture should be asked for what it shows: every few frames, if anything changed."""
        asks = self.occlusion is not None or (self.contrast is not None and len(cut.wants) > 0)
        if not asks or self.recording.frames % TEST_EVERY:
            return False
        state = (cut.nodes.tobytes(), camera)
        self.steady = self.steady + 1 if state == self.tested else 0
        self.tested = state
        return self.steady <= (0 if self.occlusion is None else KEPT)

    async def _draw(self, backend: Backend, cut: Cut, camera: Camera) -> tuple[Cut, Frame]:
        """Draw a cut, and once more with what it shows to be visible after all (LPC 4: the third pass)."""
        layer, style, drawer = self.layer, self.options.style, asyncio.get_running_loop().run_in_executor
        index = layer.index
        for last in (False, True):
            clouds = {node: layer.take(node) for node in cut.nodes.tolist()}
            frame = await drawer(self.drawer, partial(backend.draw, cut, clouds.__getitem__, camera, style))
            if layer.index is not index:
                break
            if self.contrast is not None:
                self.contrast.look(index, cut, camera, frame)
            if self.occlusion is None:
                break
            seen = self.occlusion.look(index, cut, camera, frame)
            if last or not seen:
                break
            cut = self._refine(camera)
        return cut, frame

    def _moment(self, cut: Cut, camera: Camera, frame: Frame, t: float, stats: LayerStats) -> Moment:
        """Note the state that a picture was drawn from."""
        self.recording.occluded = cut.culled.occluded
        self.recording.left_out = {} if self.occlusion is None else self.occlusion.left_out
        return Moment(
            t=t,
            stats=stats,
            splats=frame.splats,
            max_spacing_px=cut.max_spacing_px,
            camera=camera,
            size=frame.node.shape,
            packed=Moment.pack(frame),
        )
