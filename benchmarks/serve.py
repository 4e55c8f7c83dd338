"""Print what a range costs our server, beside aiohttp's static route in the same run.

    python benchmarks/serve.py [--requests 2000] [--connections 8] [--repeats 6] [--workers 2]

Each server runs as a process of its own on loopback and serves the same file of random bytes. The visitor costs next to
nothing, so that the server is what is measured: one thread keeps every connection busy, sends requests that were made
beforehand and takes each reply in one call, whose length it learned from the first. Servers take turns within every
repeat; the best of each counts. The column to trust on a busy machine is CPU per request: user and system time of the
server's processes.

Promised: at most 200 us per range of 64 KB, and at least 2.5 times the requests of the static route.
"""

from __future__ import annotations

import os
import random
import re
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import asked

if TYPE_CHECKING:
    from collections.abc import Iterator

REPOSITORY = Path(__file__).resolve().parents[1]
FILE_BYTES = 64 * 1024 * 1024
LEAST_START = 10_000_000
"""Ranges begin where positions have eight digits, so that all heads are of one length."""

OURS = """
import asyncio, sys
from pathlib import Path
from pointserve.config import ServeConfig
from pointserve.workers import serve_until, supervise
loop = None if sys.argv[2] == "asyncio" else __import__("uvloop").new_event_loop
config = ServeConfig(directory=Path(sys.argv[1]), port=0)
say = lambda url: print(url, flush=True)
if len(sys.argv) > 3:
    supervise(config, int(sys.argv[3]), loop_factory=loop, announce=say)
else:
    with asyncio.Runner(loop_factory=loop) as runner:
        runner.run(serve_until(config, ready=say))
"""

STATIC = """
import asyncio, sys
from aiohttp import web
async def main():
    app = web.Application()
    app.router.add_static("/", sys.argv[1])
    runner = web.AppRunner(app, access_log=None)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    print(f"http://127.0.0.1:{runner.addresses[0][1]}/", flush=True)
    await asyncio.Event().wait()
with asyncio.Runner() as runner:
    runner.run(main())
"""


@dataclass(frozen=True)
class Figures:
    """Of one measurement: requests a second of wall time, CPU seconds a request."""

    rate: float
    cpu: float


def cpu_seconds(pid: int) -> float:
    """CPU time of all threads of a process and of its children so far, to the nanosecond (Linux)."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    threads = Path(f"/proc/{pid}/task").glob("*/schedstat")
    own = sum(int(thread.read_text().split()[0]) for thread in threads)
    return own / 1e9 + sum(cpu_seconds(int(child)) for child in children)


class Visitor:
    """One connection, with a request under way all the time."""

    def __init__(self, port: int, size: int, chance: random.Random) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        starts = [chance.randrange(LEAST_START // 4096 + 1, (FILE_BYTES - size) // 4096) * 4096 for _ in range(64)]
        self._requests = [
            f"GET /model.lpc HTTP/1.1\r\nHost: x\r\nRange: bytes={start}-{start + size - 1}\r\n\r\n".encode()
            for start in starts
        ]
        self._sent = 0
        self.ask()
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self._socket.recv(1)
        if not head.startswith(b"HTTP/1.1 206") or f"Content-Length: {size}\r\n".encode() not in head:
            raise RuntimeError(head.decode())
        self._socket.recv(size, socket.MSG_WAITALL)
        self._reply = bytearray(len(head) + size)
        self.ask()

    def ask(self) -> None:
        self._socket.sendall(self._requests[self._sent % len(self._requests)])
        self._sent += 1

    def take(self) -> None:
        got = self._socket.recv_into(self._reply, len(self._reply), socket.MSG_WAITALL)
        if got != len(self._reply) or not self._reply.startswith(b"HTTP/1.1 206"):
            raise RuntimeError(f"{got} bytes: {bytes(self._reply[:200])!r}")

    def close(self) -> None:
        self.take()
        self._socket.close()


@contextmanager
def running(code: str, arguments: list[str]) -> Iterator[tuple[int, int]]:
    """A server as a process of its own; gives its process id and port."""
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client"))
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True,
    ) as server:  # fmt: skip
        try:
            assert server.stdout is not None
            found = re.search(r":(\d+)/", server.stdout.readline())
            assert found is not None
            yield server.pid, int(found[1])
        finally:
            server.terminate()


def measure(pid: int, port: int, size: int, requests: int, connections: int) -> Figures:
    chance = random.Random(size)
    visitors = [Visitor(port, size, chance) for _ in range(connections)]
    for count in (20, max(20, requests // connections // (1 + size // (256 << 10)))):  # the first time to warm up
        before, began = cpu_seconds(pid), time.perf_counter()
        for _ in range(count):
            for visitor in visitors:
                visitor.take()
                visitor.ask()
        wall = time.perf_counter() - began
    done = count * len(visitors)
    figures = Figures(rate=done / wall, cpu=(cpu_seconds(pid) - before) / done)
    for visitor in visitors:
        visitor.close()
    return figures


def best(figures: list[Figures]) -> Figures:
    return Figures(rate=max(each.rate for each in figures), cpu=min(each.cpu for each in figures))


def print_table(size: int, runs: dict[str, list[Figures]]) -> None:
    print(f"\n{size >> 10:>4} KB ranges       requests/s    MB/s  CPU us/request  times static  CPU of static")
    static = best(runs["aiohttp static"])
    for label, figures in runs.items():
        ours = best(figures)
        print(
            f"{label:<22} {ours.rate:>8.0f} {ours.rate * size / 1e6:>7.0f} {1e6 * ours.cpu:>15.0f}"
            f" {ours.rate / static.rate:>12.2f}x {ours.cpu / static.cpu:>14.2f}x",
            flush=True,
        )


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--requests", type=int, default=2000, help="of each turn")
    parser.add_argument("--connections", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=6)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--sizes", type=int, nargs="+", default=[4, 64, 256, 1024], help="KB")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        (Path(name) / "model.lpc").write_bytes(os.urandom(FILE_BYTES))
        servers = {
            label: stack.enter_context(running(code, [name, *arguments]))
            for label, code, arguments in (
                ("aiohttp static", STATIC, []),
                ("pointserve, asyncio", OURS, ["asyncio"]),
                ("pointserve, uvloop", OURS, ["uvloop"]),
                (f"pointserve, {options.workers} workers", OURS, ["uvloop", str(options.workers)]),
            )
        }
        for size in (kilobytes << 10 for kilobytes in options.sizes):
            runs: dict[str, list[Figures]] = {label: [] for label in servers}
            for _ in range(options.repeats):
                for label, (pid, port) in servers.items():
                    runs[label].append(measure(pid, port, size, options.requests, options.connections))
            print_table(size, runs)


if __name__ == "__main__":
    main()
