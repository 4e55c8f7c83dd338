"""The Host header of requests that pass: one word of each head is replaced, everything else stays as it is.

A client of the front asks ``127.0.0.1:PORT`` for a page; a server of many names needs to hear its own. No I/O here:
bytes in, bytes out, in any division.
"""

from __future__ import annotations

import re

LONGEST_HEAD = 64 * 1024
_REQUEST_LINE = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]+ [^ \r\n]+ HTTP/1\.[01]\r\n")


class HostRewriter:
    """Replace the Host header in a stream of HTTP/1.1 requests.

    Bodies with a Content-Length pass by count. A request whose body has no length, or that upgrades to another
    protocol, is sent with ``Connection: close`` (not for upgrades), and all that follows passes as it is: the server
    ends the connection after its answer. What is not HTTP/1 at all passes as it is.

    Parameters
    ----------
    host
        The new value, with a port where it is not the scheme's own.
    """

    def __init__(self, host: str) -> None:
        self._host = host.encode("idna" if not host.isascii() else "ascii")
        self._head = bytearray()
        self._body_left = 0
        self._transparent = False

    def feed(self, data: bytes) -> bytes:
        """Take the next bytes from the client; return those that may go on to the server now."""
        out = bytearray()
        while data:
            if self._transparent:
                out += data
                break
            if self._body_left:
                out += data[: self._body_left]
                rest = data[self._body_left :]
                self._body_left -= len(data) - len(rest)
                data = rest
                continue
            self._head += data
            data = b""
            end = self._head.find(b"\r\n\r\n")
            if end < 0:
                if len(self._head) > LONGEST_HEAD or not self._may_be_http():
                    out += self._give_up()
                break
            if _REQUEST_LINE.match(self._head) is None:
                out += self._give_up()
                break
            head, data = bytes(self._head[:end]), bytes(self._head[end + 4 :])
            self._head.clear()
            out += self._rewrite(head)
        return bytes(out)

    def finish(self) -> bytes:
        """Return what was held back of a head that never ended."""
        return self._give_up()

    def _rewrite(self, head: bytes) -> bytes:
        first, *lines = head.split(b"\r\n")
        fields = [(line.partition(b":")[0].strip().lower(), line) for line in lines]
        kept = [line for name, line in fields if name != b"host"]
        values = {name: line.partition(b":")[2].strip() for name, line in fields}
        if b"upgrade" in values or b"transfer-encoding" in values:
            self._transparent = True
            if b"upgrade" not in values:
                kept = [line for line in kept if not line.lower().startswith(b"connection:")] + [b"Connection: close"]
        elif values.get(b"content-length", b"").isdigit():
            self._body_left = int(values[b"content-length"])
        return b"\r\n".join([first, b"Host: " + self._host, *kept]) + b"\r\n\r\n"

    def _may_be_http(self) -> bool:
        line_end = self._head.find(b"\r\n")
        return line_end < 0 or _REQUEST_LINE.match(self._head) is not None

    def _give_up(self) -> bytes:
        self._transparent = True
        held = bytes(self._head)
        self._head.clear()
        return held
