"""A file on any HTTP/1.1 host, by range requests over persistent connections (LPC 4, data access layer).

The host, the caches before it and the line are not trusted: `replies` judges every head, `patience` bounds every wait,
`lanes` keeps failures from spreading, and what stands here only puts them together. One request is one explicit
``first-last`` range; bodies are taken raw. What comes out of `read` is the right number of bytes from the right place
of the file that stood there at first, or one error; that they are the model's bytes is for its checksums to say.
"""

from __future__ import annotations

import asyncio
import base64
import random
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

import httpx

from lpc.errors import StoreError, Unavailable
from lpc.ranges import ByteRange
from pointstream.goodput import Goodput, Transfer

from .base import KeepsNothing
from .breaker import Breaker, BreakerOptions
from .lanes import Lane, Lanes, plain_transports
from .patience import PatienceOptions, Tries, overdue
from .replies import Beyond, Moved, Part, Pins, Retry, Whole, judge, ranges_unsupported

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from .base import Sink

DIALLED = 4
"""Connections opened together with the first, so that what the first bytes make wanted need not wait for them."""
PORTS = {"http": 80, "https": 443}
MOST_HOPS = 5
DRAINED = 65_536
"""Surplus bytes after the wanted ones that are read to keep a connection; more, and a new one is cheaper."""
NO_TIMEOUTS = {"connect": None, "read": None, "write": None, "pool": None}
"""httpx's own time-outs are per read and let a slow drip live; `patience` has the deadline instead."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpOptions:
    """Parameters of an HTTP store.

    Parameters
    ----------
    lanes : int
        Connections, at most.
    headers : tuple of (str, str)
        Sent with every request, for example ``("Authorization", "Bearer ...")``.
    patience : PatienceOptions
        Waiting and retrying, of each range.
    breaker : BreakerOptions
        Leaving the host alone, of all ranges together.
    """

    lanes: int = 12
    headers: tuple[tuple[str, str], ...] = ()
    patience: PatienceOptions = field(default_factory=PatienceOptions)
    breaker: BreakerOptions = field(default_factory=BreakerOptions)


class HttpStore(KeepsNothing):
    """A file at an http(s) address as a store.

    Parameters
    ----------
    address : str
    clock : callable
        Seconds, monotonic: what the meter counts by.
    options : HttpOptions, optional
    transports : callable, optional
        Makes a transport of one connection at each call: what stands in for the network in tests and simulations.
    meter : Goodput, optional
        Of the link, if others share it.
    breaker : Breaker, optional
        Of the host, if others share it.
    rng : random.Random, optional
        Of the jitter between tries.

    Raises
    ------
    StoreError
        If the address cannot be one.
    """

    def __init__(
        self,
        address: str,
        *,
        clock: Callable[[], float],
        options: HttpOptions | None = None,
        transports: Callable[[], httpx.AsyncBaseTransport] | None = None,
        meter: Goodput | None = None,
        breaker: Breaker | None = None,
        rng: random.Random | None = None,
    ) -> None:
        self.options = options or HttpOptions()
        self._url, headers = _parse_address(address)
        self.name = str(self._url)
        self.host = self._url.netloc.decode("ascii", "replace")
        self.length: int | None = None
        self.meter: Goodput | None = meter or Goodput()
        self._link = self.meter
        self._breaker = breaker or Breaker(self.host, self.options.breaker)
        self._clock = clock
        self._rng = rng or random.Random(0)
        self._headers = [*headers, *self.options.headers]
        self._own_transports = transports is None
        self._lanes = Lanes(transports or plain_transports(tls=self._url.scheme == "https"), self.options.lanes)
        self._pins = Pins()
        self._whole: bytes | None = None
        self._past_caches = False
        self._distrust_tags = False

    def __repr__(self) -> str:
        return f"<HttpStore {self.name} {self._lanes}>"

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range; failures that another try may cure are retried.

        Raises
        ------
        NotFound, RangesUnsupported, ModelChanged, StoreError
            What no retry can cure.
        Unavailable
            After the last try.
        """
        body = _Body(wanted, sink)
        if self.length is not None:
            body.ends_at(self.length)
        tries = Tries(self.options.patience, self._rng, self.name)
        hops = pieces = 0
        while not body.complete:
            if self._whole is not None:
                body.restart()
                body.feed(wanted.start, self._whole[wanted.start : wanted.stop])
                break
            before = body.offset
            await self._turn()
            try:
                moved = await self._attempt(body)
            except Retry as retry:
                if self._pins.etag is None:
                    body.restart()  # the rest could be another build's
                await asyncio.sleep(self._wait(tries, retry))
                continue
            except BaseException:
                self._breaker.abandoned(self._clock())
                raise
            self._breaker.answered()
            hops, pieces = hops + moved, pieces + 1
            if hops > MOST_HOPS or pieces > self.options.patience.pieces + hops:
                raise StoreError(f"{self.name}: the host sends us round in circles")
            assert moved or body.complete or body.offset > before or self._whole is not None
        return bytes(body.data)

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Pin whatever stands there now; the next request goes past caches."""
        self._pins, self._whole, self.length = Pins(), None, None
        self._past_caches = True
        self._distrust_tags |= distrust_tags

    def reject(self, place: ByteRange) -> None:
        """Go past caches, and ask for a small file anew: one of them may have damaged it."""
        del place
        self._whole, self._past_caches = None, True

    async def close(self) -> None:
        """Close all connections."""
        await self._lanes.close()

    async def _turn(self) -> None:
        """Wait until the breaker lets a request through; Unavailable if the host is to be left alone."""
        wait = self._breaker.check(self._clock())
        if wait > 0.0:
            await asyncio.sleep(wait)
            await self._turn()

    def _wait(self, tries: Tries, retry: Retry) -> float:
        """Seconds to wait before a range is asked for again; Unavailable if it is not to be."""
        if not retry.stale:
            self._breaker.failed(self._clock(), str(retry))
        wait = tries.wait(retry)
        if not retry.stale and not self._breaker.may_retry():
            raise Unavailable(f"{self.name}: too many requests fail ({retry})") from retry
        return wait

    async def _attempt(self, body: _Body) -> bool:
        """Make one request for what is missing of a body; True if it was answered with a redirect."""
        wanted = ByteRange(body.offset, body.stop)
        watch = _Watch(self._link, self._link.begin(self._clock(), wanted.size), self._clock, self.options.patience)
        if self.length is None:
            self._lanes.dial(
                self._url.host, self._url.port or PORTS[self._url.scheme], min(DIALLED, self.options.lanes)
            )
        request = httpx.Request(
            "GET",
            self._url,
            headers=self._request_headers(wanted),
            extensions={"timeout": NO_TIMEOUTS, "trace": watch.trace},
        )
        try:
            async with (
                self._lanes.lane() as lane,
                asyncio.timeout(self.options.patience.connect_seconds) as watch.limit,
            ):
                response = await lane.transport.handle_async_request(request)
                watch.answered = True
                try:
                    return await self._take(response, wanted, body, watch, lane)
                finally:
                    await response.aclose()
        except TimeoutError as error:
            place = "in the body" if watch.received else "before the body" if watch.answered else "before the reply"
            raise Retry(f"nothing came in time {place}") from error
        except (httpx.TransportError, httpx.StreamError, OSError) as error:
            if isinstance(error, StoreError):
                raise
            stale = not (watch.connected or watch.answered)
            raise Retry(str(error) or type(error).__name__, stale=stale) from error
        finally:
            self._link.end(watch.transfer, self._clock())

    def _request_headers(self, wanted: ByteRange) -> list[tuple[str, str]]:
        headers = [("Host", self.host), ("Accept-Encoding", "identity"), ("Range", wanted.header), *self._headers]
        if self._pins.etag is not None:
            headers.append(("If-Match", self._pins.etag))  # a mismatch costs a 412, with If-Range the whole file
        if self._past_caches:
            headers.append(("Cache-Control", "no-cache"))
        return headers

    async def _take(self, response: httpx.Response, wanted: ByteRange, body: _Body, watch: _Watch, lane: Lane) -> bool:
        verdict = judge(response.status_code, response.headers, wanted, self._pins, self.name)
        if not isinstance(verdict, Part | Whole):
            lane.spoiled = True  # its body is not read
            if isinstance(verdict, Beyond):
                self.length = verdict.length
                body.ends_at(verdict.length)
                return False
            self._move(verdict)
            return True
        self._pins = replace(verdict.pins, etag=None) if self._distrust_tags else verdict.pins
        self._past_caches = False
        if self._pins.length is not None:
            self.length = self._pins.length
            body.ends_at(self.length)
        if isinstance(verdict, Whole):
            await self._take_whole(response, verdict, watch)
        else:
            await self._take_part(response, verdict, body, watch, lane)
        return False

    async def _take_part(self, response: httpx.Response, part: Part, body: _Body, watch: _Watch, lane: Lane) -> None:
        offset = part.start
        async with _chunks(response) as chunks:
            async for chunk in chunks:
                watch.count(len(chunk))
                if offset + len(chunk) > part.stop:
                    raise Retry("more bytes than the reply's Content-Range says")
                body.feed(offset, chunk)
                offset += len(chunk)
                if body.complete and part.stop - offset > DRAINED:
                    lane.spoiled = True
                    return
        if offset < part.stop:
            raise Retry(f"the body ended {part.stop - offset} bytes early")

    async def _take_whole(self, response: httpx.Response, whole: Whole, watch: _Watch) -> None:
        data = bytearray()
        async with _chunks(response) as chunks:
            async for chunk in chunks:
                watch.count(len(chunk))
                data += chunk
                if len(data) > whole.limit:
                    raise ranges_unsupported(self.name, whole.length)
        if whole.length is not None and len(data) != whole.length:
            raise Retry(f"the body has {len(data)} bytes in place of {whole.length}")
        self._whole, self.length = bytes(data), len(data)

    def _move(self, moved: Moved) -> None:
        """Follow a redirect inside the origin, or to the same host over TLS; others could be anybody."""
        try:
            target = self._url.join(moved.location)
        except httpx.InvalidURL as error:
            raise StoreError(f"{self.name} redirects to an address that cannot be one") from error
        upgraded = (self._url.scheme, target.scheme, self._url.port, target.port) == ("http", "https", None, None)
        here, there = (self._url.scheme, self._url.port), (target.scheme, target.port)
        if target.host != self._url.host or not (here == there or upgraded):
            raise StoreError(f"{self.name} redirects to {target}: open that address if you trust it")
        if upgraded:  # connections made for plain text would not check certificates
            self._lanes.renew(plain_transports(tls=True) if self._own_transports else None)
        self._url = target


class _Body:
    """A range that fills up, and its sink."""

    def __init__(self, wanted: ByteRange, sink: Sink | None) -> None:
        self.wanted = wanted
        self.stop = wanted.stop
        self.data = bytearray()
        self._sink = sink

    @property
    def offset(self) -> int:
        return self.wanted.start + len(self.data)

    @property
    def complete(self) -> bool:
        return self.offset >= self.stop

    def ends_at(self, length: int) -> None:
        self.stop = min(self.wanted.stop, max(length, self.wanted.start))

    def restart(self) -> None:
        self.data.clear()

    def feed(self, start: int, chunk: bytes) -> None:
        """Take what is needed of a piece that starts at or before the offset."""
        piece = chunk[max(0, self.offset - start) : max(0, self.stop - start)]
        if piece:
            offset = self.offset
            self.data += piece
            if self._sink is not None:
                self._sink(offset, piece)


class _Watch:
    """One request on its way: feeds the meter and moves the deadline."""

    limit: asyncio.Timeout

    def __init__(
        self, meter: Goodput, transfer: Transfer, clock: Callable[[], float], patience: PatienceOptions
    ) -> None:
        self.transfer = transfer
        self.received = 0
        self.connected = self.answered = False
        self._meter, self._clock, self._patience = meter, clock, patience
        self._sent = 0.0

    async def trace(self, event: str, _info: object) -> None:
        """Hear from httpcore what it does."""
        if event == "connection.connect_tcp.started":
            self.connected = True
        elif event == "http11.send_request_headers.started":
            self._sent = asyncio.get_running_loop().time()
            self._meter.sent(self.transfer, self._clock())
            self._postpone()

    def count(self, nbytes: int) -> None:
        self.received += nbytes
        self._meter.received(self.transfer, self._clock(), nbytes)
        self._postpone()

    def _postpone(self) -> None:
        rate = self._meter.rate(self._clock())
        self.limit.reschedule(overdue(self._sent, self.received, rate, self._patience))


def _chunks(response: httpx.Response) -> aclosing[AsyncGenerator[bytes, None]]:
    """Give the raw body, ended properly wherever the loop over it is left."""
    assert isinstance(response.stream, httpx.AsyncByteStream)
    return aclosing(cast("AsyncGenerator[bytes, None]", aiter(response.stream)))


def _parse_address(address: str) -> tuple[httpx.URL, list[tuple[str, str]]]:
    """Return the address without user and password, and the header that carries those."""
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL as error:
        raise StoreError(f"{address[:200]} is no address: {error}") from error
    if url.scheme not in ("http", "https") or not url.host:
        raise StoreError(f"{address[:200]} is no http(s) address")
    headers = [("User-Agent", "pointstream")]
    if url.userinfo:
        user = f"{url.username}:{url.password}".encode()
        headers.append(("Authorization", "Basic " + base64.b64encode(user).decode("ascii")))
        url = url.copy_with(userinfo=b"")
    return url.copy_with(fragment=None), headers
