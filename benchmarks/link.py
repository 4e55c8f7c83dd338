"""What the throttled front gives against what was asked of it, over real sockets on this machine.

    python benchmarks/link.py [--seconds 10] [--profile adsl] [--profile lan]

Rates are TCP payload bits per second that clients read, over all connections, from the first byte to the last read
before the time is up. The round trip is a byte echoed over an open, idle connection (median of 40) and a connect with
its first echo, which should cost two of them. CPU is this process: front, server and clients together.
"""

from __future__ import annotations

import asyncio
import contextlib
import statistics
import time

import asked
from rich.console import Console
from rich.table import Table

from pointlink.front import Front, Upstream, parse_upstream, precise_loop, serve_front
from pointlink.profiles import Profile, parse_profile

ECHO, BULK = b"e", b"b"


async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Echo single bytes, or send for ever."""
    with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
        while await reader.readexactly(1) == ECHO:
            writer.write(ECHO)
            await writer.drain()
        while True:
            writer.write(bytes(65536))
            await writer.drain()
    writer.close()


async def connect(front: Front) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    address = parse_upstream(front.url)
    return await asyncio.open_connection(address.host, address.port)


async def round_trips(front: Front) -> tuple[float, float]:
    """Return the median echo and the cost of connecting and one echo, in seconds."""
    firsts, echoes = [], []
    for _ in range(5):
        began = time.perf_counter()
        reader, writer = await connect(front)
        for number in range(9):
            asked = time.perf_counter() if number else began
            writer.write(ECHO)
            await reader.readexactly(1)
            (echoes if number else firsts).append(time.perf_counter() - asked)
        writer.close()
    return statistics.median(echoes), statistics.median(firsts)


async def bulk(front: Front, connections: int, seconds: float) -> tuple[float, float]:
    """Return bits per second over all connections, and the slowest connection's share of the mean."""
    streams = [await connect(front) for _ in range(connections)]
    took = [0] * connections
    span = [float("inf"), 0.0]

    async def read(number: int) -> None:
        reader, writer = streams[number]
        writer.write(BULK)
        while True:
            data = await reader.read(65536)
            now = time.perf_counter()
            if span[0] == float("inf"):
                # Bytes that arrive with the first read mark the start; they were carried before it.
                span[0] = now
                continue
            if now > span[0] + seconds:
                break
            took[number] += len(data)
            span[1] = max(span[1], now)
        writer.transport.abort()

    await asyncio.gather(*(read(number) for number in range(connections)))
    return 8 * sum(took) / (span[1] - span[0]), min(took) * connections / max(1, sum(took))


async def measure(profile: Profile, seconds: float, table: Table, name: str) -> None:
    serving = set()

    def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.add(asyncio.get_running_loop().create_task(serve(reader, writer)))

    server = await asyncio.start_server(connected, "127.0.0.1", 0)
    upstream = Upstream(scheme="tcp", host="127.0.0.1", port=server.sockets[0].getsockname()[1], path="")
    async with server, await serve_front(upstream, profile) as front:
        echo, first = await round_trips(front)
        wanted = 1e3 * profile.rtt
        up = 8e3 / profile.up_rate if profile.up_rate else 0.0
        down = 8e3 / profile.down_rate if profile.down_rate else 0.0
        table.add_row(name, "round trip, ms", f"{wanted + up + down:.2f}", f"{1e3 * echo:.2f}", "", "")
        table.add_row(name, "connect and echo, ms", f"{2 * wanted + up + down:.2f}", f"{1e3 * first:.2f}", "", "")
        for connections in (1, 4):
            cpu = time.process_time()
            rate, share = await bulk(front, connections, seconds)
            cpu = (time.process_time() - cpu) / seconds
            asked = profile.down_rate
            table.add_row(
                name,
                f"down, {connections} connection{'s' * (connections > 1)}, Mbit/s",
                f"{asked / 1e6:.4f}" if asked else "-",
                f"{rate / 1e6:.4f}",
                f"{100 * (rate / asked - 1):+.2f} %" if asked else "",
                f"slowest {share:.3f} of fair, {100 * cpu:.0f} % of a core",
            )


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--profile", action="append", dest="profiles", help="adsl if not given; more may follow")
    options = parser.parse_args()
    table = Table("link", "what", "asked", "measured", "error", "")
    for name in options.profiles or ["adsl"]:
        with asyncio.Runner(loop_factory=precise_loop) as runner:
            runner.run(measure(parse_profile(name), options.seconds, table, name))
    Console().print(table)


if __name__ == "__main__":
    main()
