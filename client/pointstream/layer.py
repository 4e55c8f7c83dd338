"""The data access layer: ask for nodes, test whether they are here, take them (LPC 4), over any store.

The frame loop calls `end_frame` with what its cut wants and draws; everything else happens between frames, on the same
event loop (`traffic`). Decoding runs in threads. See README.md for the states of a node.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np

from .options import LayerOptions
from .stats import LayerStats
from .traffic import Traffic

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from lpc.cloud import Cloud
    from lpc.header import Header
    from lpc.index import IndexTree

    from .build import Build
    from .stores import Store

__all__ = ["AccessLayer", "LayerOptions"]


class AccessLayer:
    """The nodes of one model, wherever its bytes are.

    Made by `open`; all methods are for the event loop's thread. Attributes may change between two awaits of the caller
    when the host replaces the model: take them anew each frame.
    """

    def __init__(self, traffic: Traffic, clock: Callable[[], float]) -> None:
        self._traffic, self._clock = traffic, clock

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
        clock = clock or asyncio.get_running_loop().time
        traffic = Traffic(store, options=options or LayerOptions(), clock=clock)
        try:
            await traffic.open()
        except BaseException:
            await traffic.close()
            raise
        return cls(traffic, clock)

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
        return self._traffic.wanted.anything

    @property
    def stats(self) -> LayerStats:
        """What was counted so far."""
        now, meter, residency = self._clock(), self._traffic.store.meter, self._now.residency
        return LayerStats(
            bytes_received=self._traffic.received if meter is None else meter.received_bytes,
            requests=self._traffic.requests if meter is None else meter.requests,
            payload_bytes=self._traffic.payload,
            speculative_bytes=self._traffic.foresight.received,
            idle_bytes=self._traffic.idle_bytes,
            wasted_bytes=self._traffic.foresight.wasted,
            in_flight=self._traffic.scheduler.in_flight,
            outstanding_bytes=self._traffic.scheduler.outstanding,
            goodput=None if meter is None else meter.rate(now),
            rtt=None if meter is None else meter.rtt,
            measured=meter is not None and meter.measured,
            resident_clouds=len(self._now.clouds),
            resident_bytes=residency.bytes,
            over_bytes=residency.over,
            evicted=residency.evicted,
            wanted_seconds=self._traffic.wanted.seconds(now),
            decode_seconds=self._traffic.decoder.seconds,
            build=self._traffic.builds,
            errors=self._traffic.reports,
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
        self._traffic.draws(build, np.asarray(pinned, dtype=np.int64))
        if self._traffic.stopped:
            return
        pages, nodes = build.missing(np.asarray(wants, dtype=np.int64))
        self._traffic.wanted.frame(self._clock(), pages, nodes)
        self._traffic.offer(build, pages, nodes[~build.busy[nodes]])

    @property
    def spare(self) -> bool:
        """Whether all that is wanted is under way and the link has time for what may be wanted next (`prefetch`)."""
        return self._traffic.spare

    def prefetch(self, nodes: ArrayLike) -> None:
        """Say what a later frame may want, in place of what was said before: asked for only where the link would idle.

        It delays no want by more than one request of `SchedulerOptions.ahead_seconds` or one cloud, pushes no cloud out
        of memory and is counted apart (`LayerStats.speculative_bytes`). What a store holds itself stays there.

        Parameters
        ----------
        nodes : (n,) integers
            Most urgent first; those that are not known yet stand for their page. Empty: nothing.
        """
        build = self._now
        if not self._traffic.stopped:
            pages, nodes = build.missing(np.asarray(nodes, dtype=np.int64))
            self._traffic.offer_ahead(build, pages, nodes[~build.busy[nodes]])

    async def idle(self) -> None:
        """Wait until nothing is in flight and nothing is being decoded."""
        await self._traffic.idle()

    async def close(self) -> None:
        """Stop all work and close the store."""
        await self._traffic.close()

    @property
    def _now(self) -> Build:
        assert self._traffic.build is not None
        return self._traffic.build
