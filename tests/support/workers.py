"""A Dask scheduler and two workers, each a process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from distributed import Client

if TYPE_CHECKING:
    from collections.abc import Mapping
    from contextlib import ExitStack

ROOT = Path(__file__).resolve().parents[2]


def environment() -> dict[str, str]:
    """The environment, and this checkout on the path of modules."""
    rooms = [str(ROOT / room) for room in ("common", "server", "client")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*rooms, *filter(None, [os.environ.get("PYTHONPATH")])])}


class Dask:
    """A scheduler and two workers of one thread; all end with the stack."""

    def __init__(self, folder: Path, stack: ExitStack, extra: Mapping[str, str] | None = None) -> None:
        self._stack, self._environment = stack, {**environment(), **(extra or {})}
        self._file = folder / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(self._file)]
        self._start("dask_scheduler", *options)
        while not (self._file.exists() and self._file.read_text().endswith("}")):
            time.sleep(0.02)
        self.workers = [self._worker(folder / str(number)) for number in range(2)]
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(2)

    @property
    def address(self) -> str:
        return str(json.loads(self._file.read_text())["address"])

    def _worker(self, folder: Path) -> subprocess.Popen[bytes]:
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
        options += ["--local-directory", str(folder), "--scheduler-file", str(self._file)]
        return self._start("dask_worker", *options)

    def _start(self, program: str, *options: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{program}", *options],
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process
