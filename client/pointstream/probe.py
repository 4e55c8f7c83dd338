"""A look at a host, bounded in bytes and time: a dozen requests over one connection, and one short rest."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import httpx

from lpc.errors import FormatError, StoreError, Unavailable
from lpc.header import HEADER_PROBE, parse_header

from .doctor import Observations, Seen

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpc.header import Header

ORIGIN = "https://viewer.example"
SMALL = 1024
MOST_HOPS = 5
STRANGER = '"a-tag-that-no-file-has"'


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeOptions:
    """How closely to look.

    Parameters
    ----------
    rest : float
        Seconds for which the connection is left idle; 0: not at all.
    round_trips : int
        Small requests from which the round-trip time is taken.
    goodput_bytes : int
        Bytes read to measure the goodput, at most.
    goodput_seconds : float
        Seconds of it, at most.
    patience : float
        Seconds for each step of a request.
    total : float
        Seconds for everything.
    """

    rest: float = 3.0
    round_trips: int = 4
    goodput_bytes: int = 2 << 20
    goodput_seconds: float = 4.0
    patience: float = 10.0
    total: float = 60.0


async def probe(
    address: str,
    *,
    clock: Callable[[], float],
    options: ProbeOptions | None = None,
    transport: httpx.AsyncBaseTransport | None = None,
) -> Observations:
    """Look at a host.

    Parameters
    ----------
    address : str
        Of a model.
    clock : callable
        Seconds, monotonic.
    options : ProbeOptions, optional
    transport : httpx.AsyncBaseTransport, optional
        What stands in for the network.

    Raises
    ------
    StoreError
        If the address is none, or nobody answers there.
    """
    options, url = options or ProbeOptions(), parse_address(address)
    try:
        async with (
            asyncio.timeout(options.total),
            httpx.AsyncClient(
                timeout=options.patience, limits=httpx.Limits(max_connections=1), transport=transport, trust_env=False
            ) as client,
        ):
            return await _Probe(client, url, clock, options).run()
    except (httpx.HTTPError, TimeoutError) as error:
        said = str(error) or "nothing came in time"
        raise Unavailable(f"{url.host} does not answer as a web server should: {said}") from error


def parse_address(address: str) -> httpx.URL:
    """Take an http(s) address apart.

    Raises
    ------
    StoreError
        If it is none.
    """
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL as error:
        raise StoreError(f"{address[:200]} is no address: {error}") from error
    if url.scheme not in ("http", "https") or not url.host:
        raise StoreError(f"{address[:200]} is no http(s) address")
    return url


class _Probe:
    def __init__(
        self, client: httpx.AsyncClient, url: httpx.URL, clock: Callable[[], float], options: ProbeOptions
    ) -> None:
        self._client, self._url, self._clock, self._options = client, url, clock, options
        self._connections = 0
        self._first_byte = 0.0

    async def run(self) -> Observations:
        first = await self._first()
        header, problem = _model_in(first)
        name = str(self._url.copy_with(query=None, fragment=None, username=None, password=None))
        seen = Observations(address=name, first=first, header=header, problem=problem)
        if first.status != 206 or (length := seen.length) is None:
            return seen
        tag = first.headers.get("etag", "W/")
        pin = {} if tag.startswith("W/") else {"If-Match": tag}
        middle = length // 2
        seen = replace(seen, inside=await self._get(middle, middle + 4 * SMALL, pin))
        kept = self._connections == 1
        coded = await self._get(0, SMALL, {"Accept-Encoding": "gzip, br, zstd"})
        rtts = []
        for number in range(self._options.round_trips):
            sent = self._clock()
            await self._get(number * SMALL, (number + 1) * SMALL)
            rtts.append(self._first_byte - sent)
        goodput, received = await self._goodput(length)
        seen = replace(
            seen,
            kept=kept,
            coded=coded,
            rtts=tuple(rtts),
            goodput=goodput,
            goodput_bytes=received,
            beyond=await self._get(length, length + SMALL),
            stranger=await self._get(0, SMALL, {"If-Match": STRANGER}),
            preflight=await self._preflight(),
        )
        return await self._rest(seen) if kept and self._options.rest else seen

    async def _first(self) -> Seen:
        for _ in range(MOST_HOPS):
            reply = await self._get(0, HEADER_PROBE)
            if reply.status not in (301, 302, 303, 307, 308) or "location" not in reply.headers:
                return reply
            target = self._url.join(reply.headers["location"])
            if target.host != self._url.host:
                raise StoreError(f"{self._url.host} redirects to {target.host}: look at that address if you trust it")
            self._url = target
        raise StoreError(f"{self._url.host} sends us round in circles")

    async def _get(self, start: int, stop: int, extra: dict[str, str] | None = None) -> Seen:
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity", "Origin": ORIGIN}
        return await self._ask("GET", {**headers, **(extra or {})}, start, stop)

    async def _preflight(self) -> Seen:
        headers = {
            "Origin": ORIGIN,
            "Access-Control-Request-Method": "GET",
            "Access-Control-Request-Headers": "if-match,range",
        }
        return await self._ask("OPTIONS", headers, 0, SMALL)

    async def _ask(self, method: str, headers: dict[str, str], start: int, stop: int) -> Seen:
        extensions = {"trace": self._trace}
        async with self._client.stream(method, self._url, headers=headers, extensions=extensions) as reply:
            self._first_byte = self._clock()
            body = bytearray()
            async for chunk in reply.aiter_raw():
                body += chunk
                if len(body) > stop - start:  # more than was asked for is not read: it could be the whole file
                    break
        fields = {name.lower(): value for name, value in reply.headers.items()}
        return Seen(status=reply.status_code, headers=fields, body=bytes(body), start=start, stop=stop)

    async def _trace(self, event: str, _info: object) -> None:
        self._connections += event == "connection.connect_tcp.complete"

    async def _goodput(self, length: int) -> tuple[float | None, int]:
        """Body bytes a second from the first piece on, which travelled before the clock ran."""
        stop = min(length, self._options.goodput_bytes)
        headers = {"Range": f"bytes=0-{stop - 1}", "Accept-Encoding": "identity"}
        received = 0
        async with self._client.stream("GET", self._url, headers=headers) as reply:
            began = now = 0.0
            async for chunk in reply.aiter_raw():
                now = self._clock()
                if not began:
                    began = now
                    continue
                received += len(chunk)
                if received > stop or now - began > self._options.goodput_seconds:
                    break
        return (received / (now - began), received) if received and now > began else (None, 0)

    async def _rest(self, seen: Observations) -> Observations:
        await self._get(0, SMALL)
        before = self._connections
        await asyncio.sleep(self._options.rest)
        try:
            await self._get(0, SMALL)
        except httpx.HTTPError:
            return replace(seen, rest_tried=self._options.rest)
        survived = self._connections == before
        return replace(seen, rest_tried=self._options.rest, rested=self._options.rest if survived else None)


def _model_in(first: Seen) -> tuple[Header | None, str | None]:
    try:
        return parse_header(first.body[:HEADER_PROBE]), None
    except FormatError as error:
        return None, str(error)
