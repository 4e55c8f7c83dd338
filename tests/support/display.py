"""A display of our own with somebody at it: Xvfb and xdotool."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

REPOSITORY = Path(__file__).resolve().parents[2]
PATIENCE = 60.0
"""Seconds: for what happens at once unless the machine is busy."""


def need_display() -> None:
    """Skip where there is nothing to make a display with."""
    for program in ("Xvfb", "xdotool"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")


@contextmanager
def display(size: tuple[int, int] = (1000, 800)) -> Iterator[str]:
    """Run an X server in memory; gives its DISPLAY."""
    read, write = os.pipe()
    options = ["-screen", "0", f"{size[0]}x{size[1]}x24", "-nolisten", "tcp", "-noreset"]
    command = ["Xvfb", "-displayfd", str(write), *options]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        os.close(write)
        with os.fdopen(read) as numbers:
            number = numbers.readline().strip()  # it has one when it is ready
        try:
            yield f":{number}"
        finally:
            server.terminate()


def until(happened: Callable[[], object]) -> None:
    """Wait for something that will happen; fail if it does not."""
    stop = time.monotonic() + PATIENCE
    while not happened():
        if time.monotonic() > stop:
            raise AssertionError(f"not within {PATIENCE:g} s")
        time.sleep(0.05)


class Hand:
    """Mouse and keyboard of a display."""

    def __init__(self, display: str) -> None:
        self._environment = {**os.environ, "DISPLAY": display}

    def do(self, *arguments: object) -> str:
        """Run xdotool."""
        command = ["xdotool", *map(str, arguments)]
        return subprocess.run(command, env=self._environment, capture_output=True, text=True, check=False).stdout

    def window(self, name: str) -> str:
        """Wait for a window, and put it into the corner with the keyboard on it."""
        until(lambda: self.do("search", "--onlyvisible", "--name", name).strip())
        found = self.do("search", "--onlyvisible", "--name", name).split()[0]
        self.do("windowmove", found, 0, 0)
        self.do("windowfocus", found)
        return found

    def drag(self, start: tuple[int, int], stop: tuple[int, int], button: int = 1, steps: int = 8) -> None:
        """Drag with a button."""
        self.do("mousemove", *start)
        self.do("mousedown", button)
        for step in range(1, steps + 1):
            self.do("mousemove", *(a + (b - a) * step // steps for a, b in zip(start, stop, strict=True)))
            time.sleep(0.02)  # a hand
        self.do("mouseup", button)


@contextmanager
def viewing(display: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run ``pointstream view`` on a display."""
    code = "import sys; from pointstream.command import run; sys.exit(run())"
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client"))
    with subprocess.Popen(
        [sys.executable, "-c", code, "view", *map(str, arguments)],
        env={**os.environ, "DISPLAY": display, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()
