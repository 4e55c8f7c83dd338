"""The data access layer: ask for nodes, test whether they are here, take them (LPC 4), over any store.

The frame loop calls `end_frame` with what its cut wants and draws; everything else happens between frames, on the same
event loop: requests, arrivals, retries. Decoding runs in threads. See README.md for the states of a node.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lpc.errors import Corrupt, FormatError, LpcError, ModelChanged, StoreError, Unavailable
from lpc.header import HEADER_PROBE
from lpc.ranges import ByteRange

from .arrivals import Assembly
from .build import Build
from .decoding import Decoder
from .opening import Opening, add_page
from .recovery import Recovery, RecoveryOptions
from .scheduler import Item, LinkState, Request, Scheduler, SchedulerOptions
from .stats import ErrorLog, LayerStats
from .wanted import Wanted

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from numpy.typing import ArrayLike, NDArray

    from lpc.cloud import Cloud
    from lpc.header import Header
    from lpc.index import IndexTree

    from .stores import Store


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerOptions:
    """Parameters of the access layer.

    Parameters
    ----------
    capacity : int
        Bytes of decoded clouds in memory; only the current cut may pass it.
    decode_threads : int
    decode_backlog : int
        Bytes that have arrived and wait to be decoded, at most, before more are asked for.
    tries : int
        Fetches of a cloud or page that fails its checks, before it stays missing.
    scheduler : SchedulerOptions
    recovery : RecoveryOptions
    """

    capacity: int = 512 << 20
    decode_threads: int = 2
    decode_backlog: int = 1 << 20
    tries: int = 3
    scheduler: SchedulerOptions = field(default_factory=SchedulerOptions)
    recovery: RecoveryOptions = field(default_factory=RecoveryOptions)


class AccessLayer:
    """The nodes of one model, wherever its bytes are.

    Made by `open`; all methods are for the event loop's thread. Attributes may change between two awaits of the caller
    when the host replaces the model: take them anew each frame.
    """

    def __init__(self, store: Store, *, options: LayerOptions, clock: Callable[[], float]) -> None:
        self._store, self._options, self._clock = store, options, clock
        self._build: Build | None = None
        self._builds = 0
        self._scheduler = Scheduler(options.scheduler)
        self._decoder = Decoder(options.decode_threads, clock)
        self._recovery = Recovery(options.recovery)
        self._wanted = Wanted(clock())
        self._errors = ErrorLog()
        self._tasks: set[asyncio.Task[None]] = set()
        self._quiet = asyncio.Event()
        self._received = self._requests = self._payload = 0
        self._stale = self._probing = self._stopped = False

    @classmethod
    async def open(
        cls, store: Store, *, options: LayerOptions | None = None, clock: Callable[[], float] | None = None
    ) -> AccessLayer:
        """Open a model with one request of `HEADER_PROBE` bytes.

        Returns as soon as header and first page are here; the clouds behind them go on arriving.

        Parameters
        ----------
        store : Store
            Closed by `close`, and here if the model cannot be opened.
        options : LayerOptions, optional
        clock : callable, optional
            Seconds, monotonic; the event loop's time if not given.

        Raises
        ------
        StoreError, FormatError
        """
        layer = cls(store, options=options or LayerOptions(), clock=clock or asyncio.get_running_loop().time)
        opened: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        layer._spawn(layer._probe(opened))
        try:
            await opened
        except BaseException:
            await layer.close()
            raise
        return layer

    @property
    def header(self) -> Header:
        """Header of the present build."""
        return self.index.header

    @property
    def index(self) -> IndexTree:
        """The index tree, as far as its pages have come."""
        return self._now.index

    @property
    def resident(self) -> NDArray[np.bool_]:
        """(nodes,) bool: clouds that `take` gives now."""
        return self._now.residency.resident

    @property
    def absent(self) -> NDArray[np.bool_]:
        """(nodes,) bool: known nodes that will never come: the file was cut short, or they are damaged."""
        return self._now.absent

    @property
    def wanting(self) -> bool:
        """Whether anything that the last frame wanted is not here and can still come."""
        return self._wanted.anything

    @property
    def stats(self) -> LayerStats:
        """What was counted so far."""
        now, meter, residency = self._clock(), self._store.meter, self._now.residency
        return LayerStats(
            bytes_received=self._received if meter is None else meter.received_bytes,
            requests=self._requests if meter is None else meter.requests,
            payload_bytes=self._payload,
            in_flight=self._scheduler.in_flight,
            outstanding_bytes=self._scheduler.outstanding,
            goodput=None if meter is None else meter.rate(now),
            rtt=None if meter is None else meter.rtt,
            measured=meter is not None and meter.measured,
            resident_clouds=len(self._now.clouds),
            resident_bytes=residency.bytes,
            over_bytes=residency.over,
            evicted=residency.evicted,
            wanted_seconds=self._wanted.seconds(now),
            decode_seconds=self._decoder.seconds,
            build=self._builds,
            errors=self._errors.reports,
        )

    def take(self, node: int) -> Cloud:
        """Return a resident cloud.

        Raises
        ------
        KeyError
            If it is not resident.
        """
        return self._now.clouds[node]

    def end_frame(self, wants: ArrayLike, *, pinned: ArrayLike) -> None:
        """Say what the frame's cut wants and draws, and ask for what the link allows; the rest is forgotten.

        Parameters
        ----------
        wants : (n,) integers
            Nodes that would refine the cut, most urgent first. Nodes that are not known yet stand for their page.
        pinned : (m,) integers
            Nodes of the current cut: never dropped before the next call.
        """
        build = self._now
        build.drop(build.residency.pin(np.asarray(pinned, dtype=np.int64)))
        if self._stopped:
            return
        pages, nodes = build.missing(np.asarray(wants, dtype=np.int64))
        self._wanted.frame(self._clock(), pages, nodes)
        nodes = nodes[~build.busy[nodes]]
        places = np.array([build.page_item(page) for page in pages.tolist()], dtype=np.int64).reshape(-1, 3)
        start = build.index.offset[nodes]
        self._scheduler.offer(
            np.concatenate([places[:, 0], nodes]),
            np.concatenate([places[:, 1], start]),
            np.concatenate([places[:, 2], start + build.index.size[nodes]]),
        )
        self._issue()

    async def idle(self) -> None:
        """Wait until nothing is in flight and nothing is being decoded."""
        while self._tasks or self._decoder.pending:
            self._quiet.clear()
            await self._quiet.wait()

    async def close(self) -> None:
        """Stop all work and close the store."""
        self._stopped = True
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._decoder.close()
        await self._store.close()

    @property
    def _now(self) -> Build:
        assert self._build is not None
        return self._build

    def _issue(self) -> None:
        now = self._clock()
        if self._stopped or self._recovery.paused(now):
            return
        if self._stale:
            if not self._probing:
                self._probing = True
                self._spawn(self._probe())
            return
        if self._decoder.backlog > self._options.decode_backlog or self._now.residency.full:
            return
        meter = self._store.meter
        link = None if meter is None else LinkState(meter.admission(now), meter.rtt, meter.measured)
        for request in self._scheduler.issue(now, link):
            self._spawn(self._fetch(self._now, request))

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._settle()
        if not task.cancelled():
            task.result()  # an error here is a bug: shown by the loop's exception handler, never swallowed

    def _settle(self) -> None:
        if not self._tasks and not self._decoder.pending:
            self._quiet.set()

    async def _probe(self, opened: asyncio.Future[None] | None = None) -> None:
        """Read the first bytes; header, first page and clouds are used as they come."""
        request, assembly, opening = Request(ByteRange(0, HEADER_PROBE), ()), Assembly(0), Opening()
        scheduler, build = self._scheduler, None
        scheduler.adopt(request)

        def look(*, ended: bool = False) -> None:
            nonlocal build
            if build is None and opening.look(assembly.data, ended=ended):
                build = self._begin(opening)
                self._claim(build, request, assembly, np.flatnonzero(build.index.known))
                if opened is not None:
                    opened.set_result(None)
            if build is not None:
                self._arrive(build, request, assembly)

        def sink(offset: int, chunk: bytes) -> None:
            self._land(scheduler, request, assembly, offset, chunk)
            look()

        try:
            data = await self._store.read(request.range, sink)
            look(ended=len(data) < HEADER_PROBE)
            while build is None:  # the header is larger than the probe
                await self._store.read(ByteRange(len(assembly.data), opening.needed), sink)
                look(ended=len(assembly.data) < opening.needed)
            self._recovery.answered()
        except LpcError as error:
            if opened is None or opened.done():
                self._failed(error)
            else:
                opened.set_exception(error)
        finally:
            self._probing = False
            scheduler.ended(request)
        if self._build is not None:
            self._issue()

    def _begin(self, opening: Opening) -> Build:
        """Take what was just opened for the model, in one step, if it is another build than the one at hand."""
        assert opening.index is not None
        header = opening.index.header
        self._payload += opening.needed
        self._stale = False
        if self._build is not None and self._build.index.header.digest == header.digest:
            self._store.forget(distrust_tags=True)  # the tag changed and the model did not
            return self._build
        length = header.bytes if self._store.length is None else min(header.bytes, self._store.length)
        self._builds += 1
        self._build = Build(opening.index, capacity=self._options.capacity, length=length)
        self._wanted.begin(header.nodes)
        return self._build

    def _claim(self, build: Build, request: Request, assembly: Assembly, nodes: NDArray[np.int64]) -> None:
        """Expect in the probe whatever of these nodes, and of the pages known now, lies inside it."""
        items = [item for item in build.items_within(request.range.stop, nodes) if not self._scheduler.flies(item.key)]
        self._scheduler.claim(request, tuple(items))
        assembly.expect(items)

    async def _fetch(self, build: Build, request: Request) -> None:
        scheduler, assembly = self._scheduler, Assembly(request.range.start, request.items)

        def sink(offset: int, chunk: bytes) -> None:
            self._land(scheduler, request, assembly, offset, chunk)
            self._arrive(build, request, assembly)

        try:
            data = await self._store.read(request.range, sink)
            self._recovery.answered()
            if len(data) < request.range.size:
                build.ends_at(request.range.start + len(data))
        except LpcError as error:
            self._failed(error)
        finally:
            scheduler.ended(request)
        self._issue()

    def _land(self, scheduler: Scheduler, request: Request, assembly: Assembly, offset: int, chunk: bytes) -> None:
        if request.landed == 0:
            self._requests += 1
        self._received += len(chunk)
        scheduler.landed(request, assembly.feed(offset, chunk))

    def _arrive(self, build: Build, request: Request, assembly: Assembly) -> None:
        """Take what is complete in a request: pages at once, clouds to the decoder."""
        if build is not self._build:
            return
        arrived = False
        for item, data in assembly.complete():
            arrived = True
            if item.key < 0:
                self._page_arrived(build, ~item.key, data, request, assembly)
            elif not build.residency.resident[item.key] and not build.busy[item.key]:
                build.busy[item.key] = True
                done = partial(self._decoded, build, item)
                self._decoder.decode(data, node=item.key, index=build.index, done=done)
        if arrived:
            self._issue()

    def _page_arrived(self, build: Build, page: int, data: bytes, request: Request, assembly: Assembly) -> None:
        try:
            add_page(build.index, page, data)
        except ModelChanged as error:
            self._failed(error)
            return
        except FormatError as error:
            self._damaged(build, ~page, error)
            return
        self._payload += len(data)
        build.page_came()
        self._wanted.came(self._clock(), ~page)
        if request.range.start == 0:  # the probe: what else the new page shows to lie inside it
            first = page * build.index.header.page_nodes
            nodes = np.arange(first, min(first + build.index.header.page_nodes, len(build.index)))
            self._claim(build, request, assembly, nodes)

    def _decoded(self, build: Build, item: Item, cloud: Cloud | Corrupt) -> None:
        build.busy[item.key] = False
        self._settle()
        if build is not self._build:
            return
        if isinstance(cloud, Corrupt):
            self._damaged(build, item.key, cloud)
        else:
            self._payload += item.stop - item.start
            build.add(item.key, cloud)
            self._wanted.came(self._clock(), item.key)
        self._issue()

    def _damaged(self, build: Build, key: int, error: FormatError) -> None:
        if build.failed(key, self._options.tries):
            self._errors.add("page" if key < 0 else "cloud", f"{error}; it stays missing")
            self._wanted.came(self._clock(), key)

    def _failed(self, error: LpcError) -> None:
        """Follow a change of the model, wait for a host that is down, give up on one that refuses."""
        now = self._clock()
        if isinstance(error, ModelChanged):
            self._reload(now, error)
            return
        self._errors.add("host" if isinstance(error, StoreError) else "model", str(error))
        if isinstance(error, Unavailable):
            self._recovery.failed(now)
        else:
            self._stop(now)

    def _reload(self, now: float, error: ModelChanged) -> None:
        """Cut off all requests of this build and open what stands there now; this build is drawn until then."""
        self._errors.add("model", f"{error}; reading it anew")
        if not self._recovery.may_reload(now):
            self._errors.add("host", f"{self._store.name}: the model changes again and again; the host is inconsistent")
            self._stop(now)
            return
        for task in self._tasks - {asyncio.current_task()}:
            task.cancel()
        self._scheduler = Scheduler(self._options.scheduler)
        self._stale = True
        self._store.forget()
        self._issue()

    def _stop(self, now: float) -> None:
        self._stopped = True
        self._wanted.stop(now)
