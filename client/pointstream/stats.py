"""What the access layer counts: traffic, residency, time in which something was wanted, and errors once per cause."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorReport:
    """One cause of failure.

    Parameters
    ----------
    cause : str
        ``cloud``, ``page``, ``host`` or ``model``.
    text : str
        The first message.
    count : int
        How often it happened.
    """

    cause: str
    text: str
    count: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerStats:
    """The layer at one moment; counters run since it was opened.

    Parameters
    ----------
    bytes_received, requests : int
        Body bytes and requests, retries included.
    payload_bytes : int
        Bytes of header, pages and clouds that arrived whole, passed their checks and were used.
    idle_bytes : int
        Body bytes that came while no frame wanted anything.
    speculative_bytes : int
        Body bytes of requests that were made before any frame wanted what they bring.
    wasted_bytes : int
        Those among them that no frame has drawn (`foresight`).
    in_flight, outstanding_bytes : int
        Requests without a complete reply, and their bytes that are not here.
    goodput, rtt : float or None
        Bytes per second and seconds; None without a link, priors until `measured`.
    resident_clouds, resident_bytes : int
        Decoded clouds in memory.
    over_bytes : int
        Bytes by which the current cut alone makes them pass the capacity.
    evicted : int
        Clouds dropped.
    wanted_seconds : float
        Time in which anything that could be had was wanted and not here.
    decode_seconds : float
        Time spent in decoding, summed over threads.
    build : int
        Which build of the model this is, from 1 on: all nodes change with it.
    errors : tuple of ErrorReport
    """

    bytes_received: int
    requests: int
    payload_bytes: int
    idle_bytes: int
    speculative_bytes: int
    wasted_bytes: int
    in_flight: int
    outstanding_bytes: int
    goodput: float | None
    rtt: float | None
    measured: bool
    resident_clouds: int
    resident_bytes: int
    over_bytes: int
    evicted: int
    wanted_seconds: float
    decode_seconds: float
    build: int
    errors: tuple[ErrorReport, ...]


class ErrorLog:
    """Errors, reported once per cause."""

    def __init__(self) -> None:
        self._reports: dict[str, ErrorReport] = {}

    def add(self, cause: str, text: str) -> None:
        """Count an error."""
        first = self._reports.get(cause)
        count = 1 if first is None else first.count + 1
        self._reports[cause] = ErrorReport(cause=cause, text=text if first is None else first.text, count=count)

    @property
    def reports(self) -> tuple[ErrorReport, ...]:
        """All causes so far, in order of their first error."""
        return tuple(self._reports.values())
