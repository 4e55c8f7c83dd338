"""What a link is: two rates, a round-trip time and a buffer.

Rates count TCP payload bytes, as a client sees them: IP and TCP headers, ATM cells and PPPoE are not added on top. An
ADSL line *sold* as 1.5 Mbit/s carries about 1.25 Mbit/s of payload. Loss and TCP's slow start are not part of the
model.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

_RATE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)([kmg]?)(?:bit/s|bps)?", re.IGNORECASE)
_TIME = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(ms|s)?", re.IGNORECASE)
_UNITS = {"": 1.0, "k": 1e3, "m": 1e6, "g": 1e9}

SMALLEST_QUEUE = 32 * 1024
DEFAULT_RTT = 0.05
LONGEST_RTT = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Profile:
    """A link between a client and a server.

    Parameters
    ----------
    down_rate, up_rate
        Bits per second of TCP payload towards the client and towards the server; None: no limit.
    rtt
        Round-trip time in seconds of an idle link; half of it is spent in each direction.
    queue
        Bytes that wait in front of each direction's bottleneck before senders are held back.
    """

    down_rate: float | None
    up_rate: float | None
    rtt: float
    queue: int

    def __str__(self) -> str:
        """Say the link in words, as ``pointstream link`` prints it."""
        return f"{_rate_text(self.down_rate)} down, {_rate_text(self.up_rate)} up, {self.rtt * 1e3:g} ms"


NONE = Profile(down_rate=None, up_rate=None, rtt=0.0, queue=SMALLEST_QUEUE)
ADSL = Profile(down_rate=1.25e6, up_rate=256e3, rtt=0.05, queue=32 * 1024)
LAN = Profile(down_rate=100e6, up_rate=100e6, rtt=0.001, queue=64 * 1024)
NAMED = {"none": NONE, "adsl": ADSL, "lan": LAN}


def parse_profile(text: str) -> Profile:
    """Read ``none``, ``adsl``, ``lan`` or ``RATE[,RTT]``.

    RATE is bits per second with an optional k, M or G (``1.25M``, ``800k``); it holds in both directions. RTT is
    seconds (``0.05``) or milliseconds (``50ms``), 50 ms when left out. The queue holds one round trip of bytes, at
    least 32 KiB.

    Raises
    ------
    ValueError
        The text is no profile; the message is one line for the user.
    """
    named = NAMED.get(text.strip().lower())
    if named is not None:
        return named
    rate_text, comma, rtt_text = text.partition(",")
    rate = _number(_RATE, rate_text, _UNITS)
    rtt = _number(_TIME, rtt_text, {"": 1.0, "s": 1.0, "ms": 1e-3}) if comma else DEFAULT_RTT
    if rate is None or rtt is None:
        raise ValueError(f"{text!r} is no link: give none, adsl, lan or RATE[,RTT], for example 1.25M or 800k,120ms")
    if not 1.0 <= rate <= 1e12:
        raise ValueError(f"{text!r}: the rate must be from 1 bit/s to 1000 Gbit/s, for example 1.25M")
    if rtt > LONGEST_RTT:
        raise ValueError(f"{text!r}: the round-trip time must be at most {LONGEST_RTT:g} s, for example 50ms")
    return Profile(down_rate=rate, up_rate=rate, rtt=rtt, queue=max(SMALLEST_QUEUE, math.ceil(rate / 8.0 * rtt)))


def _number(pattern: re.Pattern[str], text: str, units: dict[str, float]) -> float | None:
    match = pattern.fullmatch(text.strip())
    if match is None:
        return None
    return float(match[1]) * units[(match[2] or "").lower()]


def _rate_text(rate: float | None) -> str:
    if rate is None:
        return "no limit"
    for unit, name in ((1e9, "Gbit/s"), (1e6, "Mbit/s"), (1e3, "kbit/s")):
        if rate >= unit:
            return f"{rate / unit:g} {name}"
    return f"{rate:g} bit/s"
