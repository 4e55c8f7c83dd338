"""Print what a range costs our server, beside aiohttp's static route in the same run.

    python benchmarks/serve.py [--requests 3000] [--connections 8] [--seconds 20]

Each server runs as a process of its own on loopback and serves the same sparse-free file of random bytes; one
process with raw sockets asks for random 4 KiB-aligned ranges over keep-alive connections. The column to trust on a
busy machine is CPU per request: user and system time of the server process alone.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
FILE_BYTES = 64 * 1024 * 1024

OURS = """
import asyncio, sys
from pathlib import Path
from pointserve.cli import _serve_until_signalled
from pointserve.config import ServeConfig
loop = None if sys.argv[2] == "asyncio" else __import__("uvloop").new_event_loop
with asyncio.Runner(loop_factory=loop) as runner:
    runner.run(_serve_until_signalled(ServeConfig(directory=Path(sys.argv[1]), port=0)))
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
loop = None if sys.argv[2] == "asyncio" else __import__("uvloop").new_event_loop
with asyncio.Runner(loop_factory=loop) as runner:
    runner.run(main())
"""


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def worker(port: int, size: int, todo: list[int], deadline: float) -> int:
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=4 * 1024 * 1024)
    done = 0
    while todo and time.monotonic() < deadline:
        start = todo.pop()
        writer.write(f"GET /model.lpc HTTP/1.1\r\nHost: x\r\nRange: bytes={start}-{start + size - 1}\r\n\r\n".encode())
        head = await reader.readuntil(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 206") or f"Content-Length: {size}\r\n".encode() not in head:
            raise RuntimeError(head.decode())
        await reader.readexactly(size)
        done += 1
    writer.close()
    return done


async def load(port: int, size: int, requests: int, connections: int, seconds: float) -> tuple[int, float]:
    random_places = random.Random(size)
    todo = [random_places.randrange((FILE_BYTES - size) // 4096) * 4096 for _ in range(requests)]
    began = time.monotonic()
    counts = await asyncio.gather(*(worker(port, size, todo, began + seconds) for _ in range(connections)))
    return sum(counts), time.monotonic() - began


def measure(code: str, loop: str, folder: Path, size: int, options: argparse.Namespace) -> tuple[float, float, float]:
    """Requests per second, MB per second and CPU microseconds per request."""
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client"))
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder), loop],
        env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True,
    ) as server:  # fmt: skip
        try:
            assert server.stdout is not None
            found = re.search(r":(\d+)/", server.stdout.readline())
            assert found is not None
            port = int(found[1])
            asyncio.run(load(port, size, 200, options.connections, options.seconds))  # warms the page cache
            before = cpu_seconds(server.pid)
            done, wall = asyncio.run(load(port, size, options.requests, options.connections, options.seconds))
            return done / wall, done * size / wall / 1e6, 1e6 * (cpu_seconds(server.pid) - before) / done
        finally:
            server.terminate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=3000)
    parser.add_argument("--connections", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=20.0, help="longest time of one measurement")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    print(f"{'server':<24} {'range':>7} {'requests/s':>11} {'MB/s':>7} {'CPU us/request':>15}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "model.lpc").write_bytes(os.urandom(FILE_BYTES))
        for size in (4 << 10, 64 << 10, 256 << 10, 1 << 20):
            table = {}
            for label, code, loop in (
                ("aiohttp static", STATIC, "asyncio"),
                ("pointserve", OURS, "asyncio"),
                ("pointserve, uvloop", OURS, "uvloop"),
            ):
                runs = [measure(code, loop, folder, size, options) for _ in range(options.repeats)]
                table[label] = best = max(runs)[0], max(run[1] for run in runs), min(run[2] for run in runs)
                print(f"{label:<24} {size >> 10:>4} KB {best[0]:>11.0f} {best[1]:>7.0f} {best[2]:>15.0f}", flush=True)
            static = table.pop("aiohttp static")
            for label, best in table.items():
                print(
                    f"    {label}: {best[0] / static[0]:.1f} times the requests, {best[2] / static[2]:.2f} of the CPU"
                )


if __name__ == "__main__":
    main()
