"""Can a host serve models? Verdicts from what was seen of it; pure. `probe` looks, `doctor_cli` prints.

What a host must do is little: answer one range with 206, say truly which bytes it sends, and not code them. The rest
makes it better: strong tags that stay (a replaced model is noticed at once), persistent connections (a request costs
one round trip, not two or three), and the fields by which browsers let pages of other origins read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from lpc.errors import FormatError
from lpc.ranges import parse_content_range

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lpc.header import Header

Level = Literal["good", "advice", "failure", "unknown"]

SLOW_START = 14_600
"""Bytes that a new connection may carry in its first round trip (RFC 6928)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """One reply.

    Parameters
    ----------
    status : int
    headers : mapping of str to str
        By name in lower case.
    body : bytes
        Its first bytes.
    start, stop : int
        The range that was asked for, half open.
    """

    status: int
    headers: Mapping[str, str]
    body: bytes = b""
    start: int = 0
    stop: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Observations:
    """What was seen of a host; None where it was not asked or did not answer.

    Parameters
    ----------
    address : str
        Without user, password and query.
    first : Seen
        The first 64 KiB of the file.
    header : Header or None
        Of the model, if it is one.
    problem : str or None
        Why it is none.
    inside : Seen or None
        A range in the middle of the file, with If-Match where there is a strong tag.
    coded : Seen or None
        A range asked for by somebody who knows gzip, br and zstd.
    stranger : Seen or None
        A range with an If-Match of a tag that is not the file's.
    beyond : Seen or None
        A range that begins at the end of the file.
    preflight : Seen or None
        What a browser asks first.
    kept : bool or None
        Whether a second request went over the same connection.
    rested : float or None
        Seconds for which an idle connection lived; None if it did not, or was not tried.
    rest_tried : float
        Seconds for which it was left idle.
    rtts : tuple of float
        Seconds from request to first byte, of small ranges on an open connection.
    goodput : float or None
        Body bytes a second.
    goodput_bytes : int
        Bytes from which that was measured.
    """

    address: str
    first: Seen
    header: Header | None = None
    problem: str | None = None
    inside: Seen | None = None
    coded: Seen | None = None
    stranger: Seen | None = None
    beyond: Seen | None = None
    preflight: Seen | None = None
    kept: bool | None = None
    rested: float | None = None
    rest_tried: float = 0.0
    rtts: tuple[float, ...] = ()
    goodput: float | None = None
    goodput_bytes: int = 0

    @property
    def length(self) -> int | None:
        """Bytes of the file, if a Content-Range said so."""
        return _total(self.first)


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing in plain words."""

    topic: str
    level: Level
    text: str


def diagnose(seen: Observations) -> list[Finding]:
    """Return all findings; the host can serve models if none of them is a failure."""
    ranges = _ranges(seen)
    findings = [*ranges]
    if seen.first.status in (200, 206):
        findings.append(_model(seen))
    if can_serve(ranges):
        findings += [_tags(seen), _compression(seen), _end(seen), _cors(seen), _connections(seen), _rest(seen)]
        findings += _link(seen)
    return [finding for finding in findings if finding.text]


def advisable(findings: list[Finding]) -> bool:
    """Whether lines in the configuration of the host would help; none puts a model where nothing stands."""
    return any(found.level in ("advice", "failure") and found.topic not in ("address", "model") for found in findings)


def can_serve(findings: list[Finding]) -> bool:
    """Whether nothing stands in the way."""
    return not any(finding.level == "failure" for finding in findings)


def _ranges(seen: Observations) -> list[Finding]:
    first, topic = seen.first, "ranges"
    if first.status == 200:
        size = first.headers.get("content-length")
        whole = f" ({size} bytes)" if size else ""
        return [Finding(topic, "failure", f"Range is ignored: the whole file comes{whole}. Only tiny models work so.")]
    if first.status != 206:
        return [Finding("address", "failure", f"the host answers {first.status}: {_meaning(first.status)}.")]
    if (coding := first.headers.get("content-encoding", "identity")) != "identity":
        return [
            Finding(topic, "failure", f"ranges come coded as {coding} although identity was asked for: switch it off.")
        ]
    for reply, name in ((first, "the first range"), (seen.inside, "a range inside the file")):
        if reply is not None and (problem := _wrong(reply, name)):
            return [Finding(topic, "failure", problem)]
    return [Finding(topic, "good", "206 with a true Content-Range")]


def _wrong(reply: Seen, name: str) -> str | None:
    if reply.status != 206:
        return f"{name} is answered with {reply.status} in place of 206: {_meaning(reply.status)}."
    if reply.headers.get("content-type", "").startswith("multipart/"):
        return f"{name} comes as multipart although it is one."
    text = reply.headers.get("content-range")
    if text is None:
        return f"{name} has no Content-Range: nobody can tell which bytes these are."
    try:
        start, stop, total = parse_content_range(text)
    except FormatError:
        return f"{name} has a Content-Range that means nothing: {text[:60]!r}."
    if total is None:
        return f"{name} does not say how long the file is ({text[:60]!r})."
    if (start, stop) != (reply.start, min(reply.stop, total)):
        return f"{name} is another than was asked for: {text[:60]!r}."
    if len(reply.body) != stop - start:
        return f"{name} has {len(reply.body)} bytes, its Content-Range says {stop - start}."
    return None


def _meaning(status: int) -> str:
    known = {
        401: "it wants a user and password or a token (https://user:password@host/...)",
        403: "it does not let us read the file",
        404: "nothing stands there",
        412: "its tag changes from request to request, or If-Match is misread",
        429: "it has had too many requests from us",
    }
    if status in known:
        return known[status]
    return "it sends us elsewhere" if 300 <= status < 400 else "it fails" if status >= 500 else "it refuses"


def _model(seen: Observations) -> Finding:
    if seen.header is None:
        return Finding("model", "failure", f"the file is no model: {seen.problem}")
    length, wanted = seen.length, seen.header.bytes
    facts = f"{seen.header.samples} samples in {wanted} bytes"
    if length is not None and length < wanted:
        return Finding(
            "model", "advice", f"only {length} of {wanted} bytes are there: a coarser model; upload it anew."
        )
    if length is not None and length > wanted:
        return Finding("model", "advice", f"{length - wanted} bytes follow the model; upload it anew.")
    return Finding("model", "good", facts)


def _tags(seen: Observations) -> Finding:
    tag = seen.first.headers.get("etag")
    inside = None if seen.inside is None else seen.inside.headers.get("etag")
    if tag is None:
        return Finding("tags", "advice", "no ETag: a replaced model is noticed late, by its build id.")
    if tag.startswith("W/"):
        return Finding("tags", "advice", f"the tag is weak ({tag}): a replaced model is noticed late. Some hosts send "
                       "weak tags for a second after a change, or while they compress.")  # fmt: skip
    if inside not in (None, tag):
        return Finding("tags", "advice", f"the tag changes from reply to reply ({tag}, {inside}): several machines "
                       "behind one name? Make them agree.")  # fmt: skip
    if seen.stranger is not None and seen.stranger.status != 412:
        return Finding("tags", "advice", f"If-Match with another tag is answered with {seen.stranger.status}, not 412: "
                       "a replaced model is noticed one reply late.")  # fmt: skip
    return Finding("tags", "good", f"strong and heeded: {tag}")


def _compression(seen: Observations) -> Finding:
    coding = None if seen.coded is None else seen.coded.headers.get("content-encoding")
    if coding and coding != "identity":
        return Finding("compression", "advice", f"who knows {coding} gets the file coded, which browsers do and which "
                       "has no ranges: switch it off for .lpc.")  # fmt: skip
    return Finding("compression", "good", "none in the way")


def _end(seen: Observations) -> Finding:
    if seen.beyond is None:
        return Finding("end of file", "unknown", "")
    if seen.beyond.status != 416:
        return Finding(
            "end of file", "advice", f"a range beyond the end is answered with {seen.beyond.status}, not 416."
        )
    if not re.fullmatch(r"bytes \*/\d+", seen.beyond.headers.get("content-range", "")):
        return Finding("end of file", "good", "416, without the length")
    return Finding("end of file", "good", "416 says the length")


def _cors(seen: Observations) -> Finding:
    topic = "browsers"
    if seen.first.headers.get("access-control-allow-origin") is None:
        return Finding(topic, "advice", "pages of other origins may not read it (no Access-Control-Allow-Origin); "
                       "other programs do not care.")  # fmt: skip
    exposed = {name.strip().lower() for name in seen.first.headers.get("access-control-expose-headers", "").split(",")}
    if "*" not in exposed and (hidden := {"content-range", "etag"} - exposed):
        return Finding(topic, "advice", f"Access-Control-Expose-Headers lacks {', '.join(sorted(hidden))}.")
    reply = seen.preflight
    if reply is None:
        return Finding(topic, "unknown", "may read; the preflight was not tried")
    allowed = {name.strip().lower() for name in reply.headers.get("access-control-allow-headers", "").split(",")}
    if reply.status >= 300 or not ({"*"} & allowed or {"range", "if-match"} <= allowed):
        return Finding(topic, "advice", f"the preflight is answered with {reply.status} and does not allow Range and "
                       "If-Match: pages can read, but not pin a build.")  # fmt: skip
    return Finding(topic, "good", "pages of other origins may read it")


def _connections(seen: Observations) -> Finding:
    if seen.kept is None:
        return Finding("connections", "unknown", "")
    if not seen.kept:
        return Finding("connections", "advice", "closed after every reply: every request costs a round trip more, "
                       "over https two. Switch keep-alive on.")  # fmt: skip
    return Finding("connections", "good", "persistent")


def _rest(seen: Observations) -> Finding:
    if not seen.kept:
        return Finding("idle limit", "unknown", "")
    said = re.search(r"timeout\s*=\s*(\d+)", seen.first.headers.get("keep-alive", ""))
    if said is not None and int(said[1]) < 15:
        return Finding("idle limit", "advice", f"the host closes connections after {said[1]} s; 60 s or more spare who "
                       "looks at a picture the wait for a new one.")  # fmt: skip
    if seen.rest_tried and seen.rested is None:
        return Finding("idle limit", "advice", f"an idle connection was closed within {seen.rest_tried:g} s; 60 s or "
                       "more are better.")  # fmt: skip
    if said is not None:
        return Finding("idle limit", "good", f"{said[1]} s, says the host")
    if seen.rested is not None:
        return Finding("idle limit", "good", f"more than {seen.rested:g} s; longer was not measured")
    return Finding("idle limit", "unknown", "not measured")


def _link(seen: Observations) -> list[Finding]:
    findings = []
    if seen.rtts:
        findings.append(Finding("round trip", "good", f"{1000 * min(seen.rtts):.1f} ms, least of {len(seen.rtts)}"))
    if seen.goodput is not None:
        size = f"{seen.goodput_bytes / 1e6:.2g} MB"
        rough = " (roughly: the file is small)" if seen.goodput_bytes < 4 * SLOW_START else ""
        megabits = 8 * seen.goodput / 1e6
        rate = f"{megabits:.3g}" if megabits < 1000 else f"{megabits:.0f}"
        findings.append(Finding("goodput", "good", f"{rate} Mbit/s over {size}{rough}"))
    else:
        findings.append(Finding("goodput", "unknown", "not measured"))
    return findings


def _total(reply: Seen) -> int | None:
    try:
        return parse_content_range(reply.headers.get("content-range", ""))[2]
    except FormatError:
        return None
