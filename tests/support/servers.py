"""Our server for tests: on a free loopback port, in the running loop, in a thread, or as a process of its own."""

from __future__ import annotations

import asyncio
import os
import re
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

from pointserve.config import ServeConfig
from pointserve.listener import serving

LoopFactory = Callable[[], asyncio.AbstractEventLoop]
REPOSITORY = Path(__file__).resolve().parents[2]


@asynccontextmanager
async def serve_in_loop(directory: Path, **options: Any) -> AsyncIterator[str]:
    """Serve a folder in the running loop; gives ``http://127.0.0.1:PORT``. Options are those of `ServeConfig`."""
    options = {"recheck": 0.0, "grace": 1.0, **options}
    async with serving(ServeConfig(directory=directory, host="127.0.0.1", port=0, **options)) as url:
        yield url.rstrip("/")


@contextmanager
def serve_in_thread(directory: Path, *, loop_factory: LoopFactory | None = None, **options: Any) -> Iterator[str]:
    """Serve a folder from a thread with a loop of its own, for clients that block."""
    started: threading.Event = threading.Event()
    state: dict[str, Any] = {}

    async def run() -> None:
        state["stop"] = stop = asyncio.Event()
        state["loop"] = asyncio.get_running_loop()
        async with serve_in_loop(directory, **options) as url:
            state["url"] = url
            started.set()
            await stop.wait()

    def main() -> None:
        try:
            with asyncio.Runner(loop_factory=loop_factory) as runner:
                runner.run(run())
        except BaseException as error:
            state["error"] = error
        finally:
            started.set()

    thread = threading.Thread(target=main, daemon=True)
    thread.start()
    started.wait()
    if "url" not in state:
        raise state["error"]
    try:
        yield state["url"]
    finally:
        state["loop"].call_soon_threadsafe(state["stop"].set)
        thread.join()


@contextmanager
def serve_in_process(directory: Path, *arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run ``pointstream serve DIRECTORY --port 0``; gives the URL and the process, which is stopped at the end."""
    command = [sys.executable, "-c", "from pointserve.cli import serve; serve()", str(directory), "--port", "0"]
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client"))
    with subprocess.Popen(
        [*command, *arguments],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.search(r"http://\S+", line)
            if found is None:
                process.kill()
                raise RuntimeError(f"no address in {line!r}: {process.communicate()[1]}")
            yield found[0].rstrip("/"), process
        finally:
            if process.poll() is None:
                process.terminate()
            process.communicate()
