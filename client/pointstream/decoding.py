"""Decoding off the event loop: bytes go out to threads, clouds come back on the loop."""

from __future__ import annotations

import asyncio
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

from lpc.codec import decode_cloud
from lpc.errors import Corrupt

from .lineage import context

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from lpc.cloud import Cloud
    from lpc.index import IndexTree


def decode_checked(data: bytes, *, node: int, index: IndexTree, family: Mapping[int, Cloud | Corrupt]) -> Cloud:
    """Check the bytes of a cloud against its record and decode them; for any thread.

    `family` holds its nearest ancestors, decoded or damaged.

    Raises
    ------
    Corrupt
        Naming the node; `Untold` if only an ancestor is damaged.
    """
    if zlib.crc32(data) != int(index.crc[node]):
        raise Corrupt(f"cloud {node}: checksum differs, the file or the line damaged it")
    told_from = context(index, node, family)
    try:
        return decode_cloud(
            data,
            samples=int(index.samples[node]),
            schema=index.header.attributes,
            context=told_from,
        )
    except Corrupt as error:
        raise Corrupt(f"cloud {node}: {str(error).removeprefix('cloud: ')}") from error


class Decoder:
    """Threads that decode, and what waits for them.

    Attributes
    ----------
    backlog : int
        Bytes handed over and not decoded.
    pending : int
        Clouds likewise.
    seconds : float
        Spent in decoding, summed over threads: a processor that is too slow must not pass for a slow link.
    """

    def __init__(self, threads: int, clock: Callable[[], float]) -> None:
        self.backlog = self.pending = 0
        self.seconds = 0.0
        self._clock = clock
        self._threads = ThreadPoolExecutor(threads, thread_name_prefix="decode")
        self._closed = False

    def decode(
        self,
        data: bytes,
        *,
        node: int,
        index: IndexTree,
        family: Mapping[int, Cloud | Corrupt],
        done: Callable[[Cloud | Corrupt], None],
    ) -> None:
        """Decode a cloud; `done` is called on the running loop, later, with it or with what is wrong with it.

        Nothing is done any more once this is closed: what was being decoded then may be what others waited for.
        """
        if self._closed:
            return
        self.backlog += len(data)
        self.pending += 1
        work = asyncio.get_running_loop().run_in_executor(self._threads, self._timed, data, node, index, family)
        work.add_done_callback(partial(self._finished, len(data), done))

    def close(self) -> None:
        """Drop what waits, finish what is being decoded."""
        self._closed = True
        self._threads.shutdown(cancel_futures=True)

    def _timed(
        self, data: bytes, node: int, index: IndexTree, family: Mapping[int, Cloud | Corrupt]
    ) -> tuple[Cloud | Corrupt, float]:
        start = self._clock()
        try:
            cloud: Cloud | Corrupt = decode_checked(data, node=node, index=index, family=family)
        except Corrupt as error:
            cloud = error
        return cloud, self._clock() - start

    def _finished(
        self,
        size: int,
        done: Callable[[Cloud | Corrupt], None],
        work: asyncio.Future[tuple[Cloud | Corrupt, float]],
    ) -> None:
        self.backlog -= size
        self.pending -= 1
        if not work.cancelled():
            cloud, seconds = work.result()  # anything but Corrupt is a bug: shown by the loop's exception handler
            self.seconds += seconds
            done(cloud)
