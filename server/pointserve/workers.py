"""Several worker processes on one port, and the process that keeps them running.

Each worker listens on a socket of its own (SO_REUSEPORT): the kernel deals new connections out, and no worker waits for
another. The supervisor does nothing but start them, start anew the one that died, and stop them. All workers hold the
read end of one pipe whose write end the supervisor alone holds: when that is closed, on purpose or because the
supervisor was killed, they let their replies end and leave.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import signal
import socket
import time
from dataclasses import replace
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from lpc.errors import LpcError, StoreError

from .board import Board
from .listener import address_of, cannot_listen, serving, tls_context

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from multiprocessing.context import ForkProcess
    from typing import TypeAlias

    from .board import Seat
    from .config import ServeConfig

    LoopFactory: TypeAlias = Callable[[], asyncio.AbstractEventLoop]

PAUSE = 1.0
"""Seconds between two starts of the same worker, so that one that dies at once does not keep the machine busy."""

STOPPING = (signal.SIGINT, signal.SIGTERM)

_log = logging.getLogger("pointserve")


async def serve_until(
    config: ServeConfig,
    *,
    seat: Seat | None = None,
    share_port: bool = False,
    parent: int | None = None,
    ready: Callable[[str], None],
) -> None:
    """Serve until a signal to stop, or until the write end of the pipe `parent` is closed.

    Raises
    ------
    StoreError
        As `serving`.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in STOPPING:
        loop.add_signal_handler(number, stop.set)
    if parent is not None:
        loop.add_reader(parent, stop.set)
    async with serving(config, seat=seat, share_port=share_port) as url:
        ready(url)
        await stop.wait()
        if parent is not None:
            loop.remove_reader(parent)
        for number in STOPPING:  # a second signal does not wait for the replies under way
            loop.remove_signal_handler(number)


class Supervisor:
    """Starts, watches and stops workers.

    Parameters
    ----------
    config : ServeConfig
        Its port is a number, not 0.
    workers : int
    loop_factory : callable or None
        Of the workers' event loops.
    """

    def __init__(self, config: ServeConfig, workers: int, loop_factory: LoopFactory | None) -> None:
        self._config = config
        self._loop_factory = loop_factory
        self._board = Board(workers)
        self._fork = multiprocessing.get_context("fork")
        self._alive_read, self._alive_write = os.pipe()
        self._ready_read, self._ready_write = os.pipe()
        self._workers: dict[int, ForkProcess] = {}
        self._started: dict[int, float] = {}

    def run(self, wakeup: int, announce: Callable[[], None]) -> None:
        """Run until a byte can be read from the descriptor `wakeup`; a second byte ends replies under way, too.

        Raises
        ------
        StoreError
            If a worker dies before it was ready for the first time; its own words stand in the log.
        """
        places = range(len(self._board.rows))
        for place in places:
            self._start(place)
        ready = 0
        try:
            while True:
                pause = None if len(self._workers) == len(places) else PAUSE
                found = wait([wakeup, self._ready_read, *(w.sentinel for w in self._workers.values())], pause)
                if wakeup in found:
                    os.read(wakeup, 1)
                    return
                if self._ready_read in found:
                    before, ready = ready, ready + len(os.read(self._ready_read, 4096))
                    if before < len(places) <= ready:
                        announce()
                for place in self._reap():
                    if ready < len(places):
                        raise StoreError("a worker could not start; the lines above say why")
                    _log.error("worker %d died; it is started anew", place)
                now = time.monotonic()
                for place in places:
                    if place not in self._workers and now - self._started[place] >= PAUSE:
                        self._start(place)
        finally:
            self._stop(wakeup)

    def _reap(self) -> list[int]:
        dead = [place for place, worker in self._workers.items() if worker.exitcode is not None]
        for place in dead:
            self._workers.pop(place).join()
        return dead

    def _start(self, place: int) -> None:
        worker = self._fork.Process(target=self._work, args=(place,), name=f"worker-{place}")
        worker.start()
        self._workers[place] = worker
        self._started[place] = time.monotonic()

    def _work(self, place: int) -> None:
        os.close(self._alive_write)
        signal.set_wakeup_fd(-1)
        for number in STOPPING:
            signal.signal(number, signal.SIG_DFL)
        seat = self._board.seat(place)
        ready = serve_until(
            self._config, seat=seat, share_port=True, parent=self._alive_read, ready=lambda _: self._tell_ready()
        )
        try:
            with asyncio.Runner(loop_factory=self._loop_factory) as runner:
                runner.run(ready)
        except LpcError as error:
            _log.error("worker %d: %s", place, error)
            raise SystemExit(1) from None

    def _tell_ready(self) -> None:
        os.write(self._ready_write, b".")

    def _stop(self, wakeup: int) -> None:
        """Let replies end, within the grace that each worker keeps itself, and a little more."""
        os.close(self._alive_write)
        deadline = time.monotonic() + self._config.grace + 5
        while self._workers and (left := deadline - time.monotonic()) > 0:
            if wakeup in wait([wakeup, *(worker.sentinel for worker in self._workers.values())], left):
                break
            self._reap()
        for worker in self._workers.values():
            worker.kill()
            worker.join()
        for descriptor in (self._alive_read, self._ready_read, self._ready_write):
            os.close(descriptor)


@contextlib.contextmanager
def _stop_signals() -> Iterator[int]:
    """Descriptor from which a byte can be read for every signal to stop."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    before = {number: signal.signal(number, lambda *_: None) for number in STOPPING}
    wakeup = signal.set_wakeup_fd(write)
    try:
        yield read
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(read)
        os.close(write)


def supervise(
    config: ServeConfig, workers: int, *, loop_factory: LoopFactory | None, announce: Callable[[str], None]
) -> None:
    """Serve with several workers until a signal to stop.

    Parameters
    ----------
    config : ServeConfig
    workers : int
        Processes.
    loop_factory : callable or None
        Of their event loops.
    announce : callable of str
        Called with the URL once all of them listen.

    Raises
    ------
    StoreError
        As `serving`, and where the system has no SO_REUSEPORT.
    """
    if not hasattr(socket, "SO_REUSEPORT") or not hasattr(os, "fork"):
        raise StoreError("this system cannot share a port among processes; serve with --workers 1")
    tls_context(config)  # what is wrong with the certificate is said once, before any worker starts
    with _reserved_port(config) as port, _stop_signals() as wakeup:
        config = replace(config, port=port)
        Supervisor(config, workers, loop_factory).run(wakeup, lambda: announce(address_of(config, port)))


@contextlib.contextmanager
def _reserved_port(config: ServeConfig) -> Iterator[int]:
    """Hold a port without listening on it: workers may share it, and nobody else takes it meanwhile."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            config.host, config.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind) as probe:  # does not share: it fails where anybody listens already
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            port = probe.getsockname()[1]
        held = socket.socket(family, kind)
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        held.bind((address[0], port, *address[2:]))
    except OSError as error:
        raise cannot_listen(config, error) from error
    with held:
        yield port
