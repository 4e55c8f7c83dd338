"""``pointstream link`` as a user meets it, in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner

from pointlink.cli import link

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[2]


class Hello(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = f"{self.path} at {self.headers['Host']}".encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    http = HTTPServer(("127.0.0.1", 0), Hello)
    thread = threading.Thread(target=http.serve_forever, args=(0.02,))
    thread.start()
    yield f"127.0.0.1:{http.server_port}"
    http.shutdown()
    thread.join()
    http.server_close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_prints_its_address_relays_and_ends_on_a_signal(server: str, number: signal.Signals) -> None:
    path = os.pathsep.join(str(ROOT / room) for room in ("common", "server", "client"))
    command = [
        sys.executable,
        "-c",
        "from pointlink.cli import link; link()",
        f"http://{server}/dir",
        "--profile",
        "lan",
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path}
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:")
        assert url.endswith("/dir")
        with urllib.request.urlopen(f"{url}/a.lpc") as reply:
            assert reply.read().decode() == f"/dir/a.lpc at {server}"
        process.send_signal(number)
        assert process.wait() == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["ftp://x/", "--profile", "adsl"], "is no server address"),
        (["http://127.0.0.1:9", "--profile", "quick"], "is no link"),
        (["http://127.0.0.1:9"], "--profile"),
        (["http://127.0.0.1:9", "--profile", "adsl", "--port", "70000"], "70000"),
    ],
)
def test_wrong_arguments_end_with_2(arguments: list[str], says: str) -> None:
    result = CliRunner().invoke(link, arguments)
    assert result.exit_code == 2
    assert says in result.output


def test_nobody_there_ends_with_1_and_one_line() -> None:
    with HTTPServer(("127.0.0.1", 0), Hello) as closed:
        port = closed.server_port
    result = CliRunner().invoke(link, [f"http://127.0.0.1:{port}", "--profile", "adsl"])
    assert result.exit_code == 1
    reason = f"cannot connect to 127.0.0.1:{port} (Connection refused)"
    assert result.stderr.strip() == f"Error: {reason}; check the address and that this server runs"
    assert result.stdout == ""
