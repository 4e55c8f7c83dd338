"""One line a reply: who, what, how much of it, how long. Never a query, which may hold a signature."""

from __future__ import annotations

import datetime as dt
import json
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from aiohttp import web
from aiohttp.abc import AbstractAccessLogger

from .board import CUT

if TYPE_CHECKING:
    from collections.abc import Callable

    from .board import Seat

LOGGER = logging.getLogger("pointserve")

SENT_BYTES = web.RequestKey("sent_bytes", int)
"""Bytes of the body that were sent; not set where the whole of a small reply was."""

BEGAN = web.RequestKey("began", float)
"""When the head of the request was there, by the ledger's clock; the event loop's own time may be a millisecond old."""

SHOWN = 200
"""Characters of a Range field that are repeated."""


class Line(dict[str, Any]):
    """What is said of one reply: ``key=value`` as text, an object as JSON."""

    def __str__(self) -> str:
        return (
            f'peer={self["peer"]} method={self["method"]} path="{_safe(self["path"])}" status={self["status"]}'
            f' bytes={self["bytes"]} range="{_safe(self["range"] or "-")}" ms={self["ms"]:.1f}'
        ) + (" cut=1" if self["cut"] else "")


def _safe(text: str) -> str:
    return "".join(c if c.isprintable() and c != '"' else "?" for c in text)


class JsonFormatter(logging.Formatter):
    """Every record as one JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        moment = dt.datetime.fromtimestamp(record.created, dt.UTC).isoformat(timespec="milliseconds")
        facts = record.msg if isinstance(record.msg, Line) else {"message": record.getMessage()}
        if record.exc_info:
            facts = {**facts, "trace": self.formatException(record.exc_info)}
        return json.dumps({"time": moment, "level": record.levelname.lower(), **facts})


class Ledger:
    """Counts replies and writes their lines.

    Parameters
    ----------
    seat : Seat
        Where they are counted.
    clock : callable of float
        Monotonic seconds.
    """

    def __init__(self, seat: Seat, clock: Callable[[], float]) -> None:
        self._seat = seat
        self.clock = clock

    def note(self, request: web.BaseRequest, status: int, sent: int, *, cut: bool = False) -> None:
        """Take note of a reply that ended, as promised or `cut` short."""
        now = self.clock()
        seconds = now - request.get(BEGAN, now)
        self._seat.count(status, sent, seconds)
        if cut:
            self._seat.row[CUT] += 1
        if LOGGER.isEnabledFor(logging.INFO):
            wanted = request.headers.get("Range")
            line = Line(
                peer=request.remote,
                method=request.method,
                path=request.rel_url.raw_path,
                status=status,
                bytes=sent,
                range=None if wanted is None else wanted[:SHOWN],
                ms=round(1000 * seconds, 1),
                cut=cut,
            )
            LOGGER.info(line)

    def logger_class(self) -> partial[AccessLog]:
        """Return what aiohttp calls to make its access logger."""
        return partial(AccessLog, ledger=self)


class AccessLog(AbstractAccessLogger):
    """The ledger as aiohttp wants it."""

    def __init__(self, logger: logging.Logger, log_format: str, *, ledger: Ledger) -> None:
        super().__init__(logger, log_format)
        self._ledger = ledger

    def log(self, request: web.BaseRequest, response: web.StreamResponse, time: float) -> None:  # noqa: ARG002
        """Take note of a reply."""
        without_body = request.method == "HEAD" or response.status in (204, 304)
        sent = request.get(SENT_BYTES)
        if sent is None:
            sent = 0 if without_body else response.content_length or 0
        self._ledger.note(request, response.status, sent)
