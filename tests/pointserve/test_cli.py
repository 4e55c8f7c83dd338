"""``pointstream serve`` as a process."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner
from support.rawhttp import RawConnection
from support.servers import serve_in_process

from pointserve.cli import serve

if TYPE_CHECKING:
    from pathlib import Path

WriteModel = Callable[..., bytes]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_lets_replies_end_and_then_stops(models: Path, model: WriteModel, number: signal.Signals) -> None:
    data = model(size=24_000_000)

    async def run() -> None:
        async with RawConnection(url) as reading, RawConnection(url) as idle:
            assert (await idle.ask("/healthz")).status == 200
            reading.writer.write(b"GET /david.lpc HTTP/1.1\r\nHost: t\r\nRange: bytes=5-\r\n\r\n")
            await reading.read_head()
            process.send_signal(number)
            assert await idle.at_end(), "an idle connection is closed at once"
            assert await reading.reader.readexactly(len(data) - 5) == data[5:]
            assert await reading.at_end()

    with serve_in_process(models) as (url, process):
        asyncio.run(run())
        out, log = process.communicate(timeout=20)
        assert process.returncode == 0
        assert out == ""
        assert re.search(
            r'peer=127\.0\.0\.1 method=GET path="/david\.lpc" status=206 bytes=23999995 range="bytes=5-" ms=', log
        )
        assert "Traceback" not in log


def test_a_missing_folder_is_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(serve, [str(tmp_path / "nowhere")])
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "nowhere is not a folder" in result.output


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        result = CliRunner().invoke(serve, [str(tmp_path), "--port", str(taken.getsockname()[1])])
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "is in use" in result.output


@pytest.mark.parametrize("arguments", [[], ["--port", "70000", "."], ["--port", "x", "."], ["--nonsense", "."]])
def test_wrong_arguments_exit_2(arguments: list[str]) -> None:
    assert CliRunner().invoke(serve, arguments).exit_code == 2
