"""Requests on their way: what arrives is checked, decoded and made resident; what fails is waited for or given up.

This is the half of the access layer that runs between frames, on the event loop. `layer` is the other half.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from lpc.context import is_told
from lpc.errors import Corrupt, FormatError, LpcError, ModelChanged, StoreError, Unavailable
from lpc.header import HEADER_PROBE
from lpc.ranges import ByteRange

from .arrivals import Assembly
from .build import Arrived, Build
from .decoding import Decoder
from .foresight import Foresight
from .lineage import ancestors
from .offers import Item, Request
from .opening import Opening, add_page, hole_at, naming, vouch_opening
from .recovery import Recovery
from .scheduler import LinkState, Scheduler
from .stats import ErrorLog, ErrorReport
from .wanted import Wanted

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from numpy.typing import NDArray

    from lpc.cloud import Cloud

    from .options import LayerOptions
    from .stores import Store


class Traffic:
    """Everything between a store and the build that its bytes make up.

    Attributes
    ----------
    build : Build or None
        The present one; None until the first page is here. Replaced in one step when the host changes the model.
    builds : int
        How many there were.
    scheduler, local : Scheduler
        Of what comes over the link, and of what the store holds. Replaced together with the build.
    decoder : Decoder
    wanted : Wanted
    foresight : Foresight
    errors : ErrorLog
    received, requests, payload : int
        Bytes that came, requests that brought any, bytes that were used.
    idle_bytes : int
        Bytes that came while no frame wanted anything: ahead, or for a view that the camera has left.
    stopped : bool
        Nothing is asked for any more.
    """

    def __init__(self, store: Store, *, options: LayerOptions, clock: Callable[[], float]) -> None:
        self.store = store
        self.build: Build | None = None
        self.builds = 0
        self.scheduler, self.local = Scheduler(options.scheduler), Scheduler(options.scheduler)
        self.decoder = Decoder(options.decode_threads, clock)
        self.wanted = Wanted(clock())
        self.foresight = Foresight()
        self.errors = ErrorLog()
        self.received = self.requests = self.payload = self.idle_bytes = 0
        self.stopped = False
        self._options, self._clock = options, clock
        self._recovery = Recovery(options.recovery)
        self._tasks: set[asyncio.Task[None]] = set()
        self._quiet = asyncio.Event()
        self._stale = self._probing = False

    async def open(self) -> None:
        """Read the first bytes; return once header and first page are here.

        Raises
        ------
        StoreError, FormatError
        """
        opened: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._spawn(self._probe(opened))
        await opened

    async def idle(self) -> None:
        """Wait until nothing is in flight and nothing is being decoded."""
        while self._tasks or self.decoder.pending:
            self._quiet.clear()
            await self._quiet.wait()

    async def close(self) -> None:
        """Stop all work and close the store."""
        self.stopped = True
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.decoder.close()
        await self.store.close()

    @property
    def reports(self) -> tuple[ErrorReport, ...]:
        """What went wrong, once per cause, and what the store has to do without."""
        warnings = (ErrorReport(cause="store", text=text) for text in self.store.warnings)
        return (*self.errors.reports, *warnings)

    def offer(self, build: Build, pages: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Replace what is wanted, and ask for what may be asked for now; what the store holds waits for no link.

        Parameters
        ----------
        build : Build
        pages, nodes : (n,) int64
            Pages before nodes, each most urgent first.
        """
        keys, starts, stops, held = build.places(pages, nodes)
        self.local.offer(keys[held], starts[held], stops[held])
        line = 0  # the first want may wait for its ancestors: what these bring along would delay it
        while line + 1 < len(nodes) and nodes[line] in ancestors(build.index, int(nodes[line + 1])):
            line += 1
        alone = nodes[: line + 1] if line else None
        self.scheduler.offer(keys[~held], starts[~held], stops[~held], alone=alone)
        self.issue()

    def offer_ahead(self, build: Build, pages: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Replace what may be wanted later: asked for where the link would idle, and only over the link."""
        keys, starts, stops, held = build.places(pages, nodes)
        self.scheduler.offer_ahead(keys[~held], starts[~held], stops[~held])
        self.issue()

    @property
    def spare(self) -> bool:
        """Whether there is a link, with all that is wanted under way, and room for what comes ahead."""
        return (
            not (self.stopped or self._stale)
            and self.store.meter is not None
            and not self.scheduler.waiting
            and self.build is not None
            and self.build.roomy(self.scheduler.ahead)
        )

    def draws(self, build: Build, nodes: NDArray[np.int64]) -> None:
        """Keep what a frame draws until the next one."""
        self.foresight.drew(nodes)
        self.foresight.dropped(build.drop(build.residency.pin(nodes)))

    def issue(self) -> None:
        """Ask for what may be asked for now."""
        now = self._clock()
        build = self.build
        if build is None or self.stopped:
            return
        if self._stale:
            if not self._probing and not self._recovery.paused(now):
                self._probing = True
                self._spawn(self._probe())
            return
        if self.decoder.backlog > self._options.decode_backlog or build.residency.full:
            return
        for request in self.local.issue(now, None):
            self._spawn(self._fetch(build, request, self.local))
        if self._recovery.paused(now):
            return
        meter = self.store.meter
        link = None if meter is None else LinkState(meter.admission(now), meter.rtt, meter.measured)
        for request in self.scheduler.issue(now, link, ahead=build.roomy(self.scheduler.ahead)):
            self._spawn(self._fetch(build, request, self.scheduler))

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
        if not self._tasks and not self.decoder.pending:
            self._quiet.set()

    async def _probe(self, opened: asyncio.Future[None] | None = None) -> None:
        """Read the first bytes; header, first page and clouds are used as they come."""
        request, assembly, opening = Request(ByteRange(0, HEADER_PROBE), ()), Assembly(0), Opening()
        scheduler, build = self.scheduler, None
        scheduler.adopt(request)

        def look(*, ended: bool = False) -> None:
            nonlocal build
            if build is None and opening.look(assembly.data, ended=ended):
                build = self._begin(opening, assembly.data)
                assembly.used = opening.used
                self._claim(build, request, assembly, np.flatnonzero(build.index.known))
                if opened is not None:
                    opened.set_result(None)
            if build is not None:
                self._arrive(build, request, assembly)

        def sink(offset: int, chunk: bytes) -> None:
            self._land(scheduler, request, assembly, offset, chunk)
            look()

        try:
            request.range = ByteRange(0, await self.store.opening_bytes())
            data = await self.store.read(request.range, sink)
            look(ended=len(data) < request.range.size)
            while build is None:  # the header is larger than the probe, or the first page is not here
                if not hole_at(self.store, len(assembly.data)):
                    await self.store.read(ByteRange(len(assembly.data), opening.needed), sink)
                look(ended=len(assembly.data) < opening.needed)
            build.tail = assembly.rest()
            self._recovery.answered()
        except LpcError as error:
            if opened is None or opened.done():
                self._failed(error)
            else:
                opened.set_exception(naming(self.store.name, error))
        finally:
            self._probing = False
            scheduler.ended(request)
            if build is not None:
                self._forget_orphans(build)
        self.issue()

    def _begin(self, opening: Opening, data: bytearray) -> Build:
        """Take what was just opened for the model, in one step, if it is another build than the one at hand."""
        assert opening.index is not None
        header = opening.index.header
        self.payload += opening.used
        self._stale = False
        if self.build is not None and self.build.index.header.digest == header.digest:
            self.store.forget(distrust_tags=True)  # the tag changed and the model did not
            return self.build
        vouch_opening(self.store, opening, data)
        self.builds += 1
        self.build = Build(opening.index, capacity=self._options.capacity, store=self.store)
        self.wanted.begin(header.nodes)
        self.foresight.begin(header.nodes, header.page_nodes)
        return self.build

    def _claim(self, build: Build, request: Request, assembly: Assembly, nodes: NDArray[np.int64]) -> None:
        """Expect in the probe whatever of these nodes, and of the pages known now, lies inside it.

        What it cuts in two is asked for when it is over: the rest of it.
        """
        stop = request.range.stop
        items = [item for item in build.items_before(stop, nodes) if not self.scheduler.flies(item.key)]
        self.scheduler.claim(request, tuple(items))
        assembly.expect(item for item in items if item.stop <= stop)

    async def _fetch(self, build: Build, request: Request, scheduler: Scheduler) -> None:
        assembly = Assembly(request.range.start, request.items)

        def sink(offset: int, chunk: bytes) -> None:
            self._land(scheduler, request, assembly, offset, chunk)
            self._arrive(build, request, assembly)

        try:
            wanted = request.range
            if here := build.take_tail(wanted):
                assembly.feed(wanted.start, here)
                request.held = len(here)
                wanted = ByteRange(wanted.start + len(here), wanted.stop)
            data = await self.store.read(wanted, sink)
            self._recovery.answered()
            if len(data) < wanted.size:
                build.ends_at(wanted.start + len(data))
        except LpcError as error:
            self._failed(error)
        finally:
            scheduler.ended(request)
            self._forget_orphans(build)
        self.issue()

    def _land(self, scheduler: Scheduler, request: Request, assembly: Assembly, offset: int, chunk: bytes) -> None:
        if request.landed == 0:
            self.requests += 1
        self.received += len(chunk)
        if request.ahead:
            self.foresight.landed(len(chunk))
        if not self.wanted.anything:
            self.idle_bytes += len(chunk)
        scheduler.landed(request, assembly.feed(offset, chunk))

    def _arrive(self, build: Build, request: Request, assembly: Assembly) -> None:
        """Take what is complete in a request: pages at once, clouds to the decoder."""
        if build is not self.build:
            return
        arrived = False
        for item, data in assembly.complete():
            arrived = True
            if item.key < 0:
                self._page_arrived(build, ~item.key, data, request, assembly)
            elif not build.residency.resident[item.key] and not build.busy[item.key]:
                build.busy[item.key] = True
                self._decode(build, Arrived(item, data, request.brings(item) if request.ahead else 0))
        if arrived:
            self.issue()

    def _decode(self, build: Build, came: Arrived) -> None:
        """Decode a cloud once those that it is told from are here."""
        family = build.family(came.item.key)
        if isinstance(family, int):
            build.wait(came, family)
            return
        done = partial(self._decoded, build, came.item, came.data, ahead=came.ahead)
        self.decoder.decode(came.data, node=came.item.key, index=build.index, family=family, done=done)

    def _go_on(self, build: Build, node: int) -> None:
        """Decode what waited for a node."""
        for came in build.release(node):
            self._decode(build, came)

    def _forget_orphans(self, build: Build) -> None:
        """Let go of what waits for clouds that never come; if much waits, also for those that are not on their way."""
        much = build.waiting_bytes > self._options.most_orphans
        lost = [
            node
            for node in build.waiting
            if build.absent[node]
            or (much and not (build.busy[node] or self.scheduler.flies(node) or self.local.flies(node)))
        ]
        build.forget(lost)

    def _page_arrived(self, build: Build, page: int, data: bytes, request: Request, assembly: Assembly) -> None:
        try:
            add_page(build.index, page, data)
        except ModelChanged as error:
            self._failed(error)
            return
        except FormatError as error:
            self._damaged(build, ~page, error)
            return
        self.payload += len(data) * build.passed(build.page_item(page), data)
        build.page_came(page)
        if request.ahead:
            self.foresight.came(~page, request.brings(build.page_item(page)))
        self.wanted.came(self._clock(), ~page)
        if request.range.start == 0:  # the probe: what else the new page shows to lie inside it
            first = page * build.index.header.page_nodes
            nodes = np.arange(first, min(first + build.index.header.page_nodes, len(build.index)))
            self._claim(build, request, assembly, nodes)

    def _decoded(self, build: Build, item: Item, data: bytes, cloud: Cloud | Corrupt, *, ahead: int) -> None:
        build.busy[item.key] = False
        self._settle()
        if build is not self.build:
            return
        if isinstance(cloud, Corrupt):
            self._damaged(build, item.key, cloud)
            self._forget_orphans(build)
        else:
            self.payload += len(data) * build.passed(item, data)
            if ahead:
                self.foresight.came(item.key, ahead)
            undrawn = ahead > 0 and not self.wanted.holds(item.key)
            self.foresight.dropped(build.add(item.key, cloud, ahead=undrawn))
            self.wanted.came(self._clock(), item.key)
            self._go_on(build, item.key)
        self.issue()

    def _damaged(self, build: Build, key: int, error: FormatError) -> None:
        if build.failed(key, self._options.tries):
            below = key >= 0 and is_told(build.index.header) and (build.index.children[key] >= 0).any()
            what = "it stays missing, and what is below it" if below else "it stays missing"
            self.errors.add("page" if key < 0 else "cloud", f"{self.store.name}: {error}; {what}")
            self.wanted.came(self._clock(), key)

    def _failed(self, error: LpcError) -> None:
        """Follow a change of the model, wait for a host that is down, give up on one that refuses."""
        now = self._clock()
        if isinstance(error, ModelChanged):
            self._reload(now, error)
            return
        cause = "host" if isinstance(error, StoreError) else "model"
        self.errors.add(cause, str(naming(self.store.name, error)))
        if isinstance(error, Unavailable):
            self._recovery.failed(now)
        else:
            self._stop(now)

    def _reload(self, now: float, error: ModelChanged) -> None:
        """Cut off all requests of this build and open what stands there now; this build is drawn until then."""
        self.errors.add("model", f"{naming(self.store.name, error)}; reading it anew")
        if not self._recovery.may_reload(now):
            self.errors.add("host", f"{self.store.name}: the model changes again and again; the host is inconsistent")
            self._stop(now)
            return
        for task in self._tasks - {asyncio.current_task()}:
            task.cancel()
        self.scheduler, self.local = Scheduler(self._options.scheduler), Scheduler(self._options.scheduler)
        self._stale = True
        self.store.forget()
        self.issue()

    def _stop(self, now: float) -> None:
        self.stopped = True
        self.wanted.stop(now)
