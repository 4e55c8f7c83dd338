"""What an operator relies on: limits, figures, logs, TLS, and workers that come back."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import ssl
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from prometheus_client.parser import text_string_to_metric_families
from support.rawhttp import RawConnection, ask_once
from support.servers import REPOSITORY, serve_in_loop, serve_in_process
from support.shelf import make_model

from lpc.errors import StoreError
from pointserve.board import FIRST_PEER, PEERS, Board
from pointserve.cli import serve
from pointserve.config import ServeConfig
from pointserve.listener import Guests, tls_context
from pointserve.rate import BURST_SECONDS, RateCap

WriteModel = Callable[..., bytes]


def test_every_option_is_documented() -> None:
    text = (REPOSITORY / "docs" / "hosting.md").read_text()
    options = [name for option in serve.params for name in option.opts if name.startswith("--")]
    assert len(options) > 10
    assert [name for name in options if f"`{name}" not in text] == []


# limits


async def test_a_head_has_to_come_in_time_however_it_drips(models: Path, model: WriteModel) -> None:
    data = model()
    async with serve_in_loop(models, head_seconds=0.3) as url, RawConnection(url) as silent, RawConnection(url) as drip:
        assert (await drip.ask("/david.lpc")).body == data
        await asyncio.sleep(0.5)  # longer than a head may take: between requests a connection may rest
        assert (await drip.ask("/david.lpc")).body == data

        async def one_byte_at_a_time() -> None:
            with contextlib.suppress(ConnectionError):
                for byte in b"GET /david.lpc HTTP/1.1\r\nHost: t\r\nX: " + b"y" * 1000:
                    drip.writer.write(bytes([byte]))
                    await asyncio.sleep(0.05)

        dripping = asyncio.ensure_future(one_byte_at_a_time())
        assert await drip.at_end()
        assert await silent.at_end()
        dripping.cancel()


async def test_a_slow_reply_is_no_late_head(models: Path, model: WriteModel) -> None:
    data = model(size=60_000)
    async with serve_in_loop(models, head_seconds=0.05, rate=8 * 200_000) as url, RawConnection(url) as connection:
        assert (await connection.ask("/david.lpc")).body == data


def test_guests_are_counted_over_all_workers() -> None:
    board = Board(3)
    workers = [Guests(5, 3, board.seat(number)) for number in range(3)]
    assert [workers[number].enter("a") for number in (0, 1, 2, 0)] == [True, True, True, False]
    assert [workers[number].enter("b") for number in (0, 1, 2)] == [True, True, False]
    workers[1].leave("a")
    assert workers[2].enter("a")
    board.seat(0)  # worker 0 died with the connections of a and b and is started anew
    assert [workers[0].enter("b"), workers[0].enter("c")] == [True, True]
    assert board.rows[:, FIRST_PEER : FIRST_PEER + PEERS].sum() == 5


def test_rate_cap_gives_each_address_its_rate_in_the_long_run() -> None:
    now = [100.0]
    cap = RateCap(1000.0, clock=lambda: now[0], share=lambda address: {"half": 0.5}.get(address, 1.0))
    for address, rate in (("one", 1000.0), ("half", 500.0)):
        now[0], sent = 100.0, 0
        while now[0] < 110.0:
            now[0] += cap.delay(address, 50)
            sent += 50
        assert sent == pytest.approx(rate * (10 + BURST_SECONDS), rel=0.02)
    for number in range(5000):
        cap.delay(f"address {number}", 1)
        now[0] += 0.01
    assert len(cap._paid) < 3000, "addresses that have paid are forgotten"


async def test_rate_holds_over_all_connections_of_an_address(models: Path, model: WriteModel) -> None:
    data = model(size=60_000)
    loop = asyncio.get_running_loop()
    async with serve_in_loop(models, rate=8 * 400_000) as url:
        began = loop.time()
        replies = await asyncio.gather(*(ask_once(url, "/david.lpc") for _ in range(6)))
        seconds = loop.time() - began
    assert [reply.body for reply in replies] == [data] * 6
    assert seconds > (6 * 60_000 - 40_000) / 400_000 - BURST_SECONDS


# figures and logs


async def test_metrics_count_what_happened(models: Path, model: WriteModel) -> None:
    model()
    async with serve_in_loop(models, per_address=2) as url, RawConnection(url) as connection:
        for lines in (["Range: bytes=0-99"], ["Range: bytes=0-9"], ["Range: bytes=10000-"], []):
            await connection.ask("/david.lpc", *lines)
        await connection.ask("/absent.lpc")
        async with RawConnection(url), RawConnection(url) as refused:
            assert (await refused.read()).status == 503
        reply = await connection.ask("/metrics")
        assert reply.headers["content-type"].startswith("text/plain; version=0.0.4")
    figures = {
        sample.name + "".join(f" {value}" for value in sample.labels.values()): sample.value
        for family in text_string_to_metric_families(reply.body.decode())
        for sample in family.samples
    }
    assert figures["pointserve_models"] == 1
    assert figures["pointserve_workers"] == 1
    assert figures["pointserve_refused_connections_total"] == 1
    assert figures["pointserve_requests_total 206"] == 2
    assert figures["pointserve_requests_total 200"] == 1
    assert figures["pointserve_requests_total 404"] == 1
    assert figures["pointserve_requests_total 416"] == 1
    assert figures["pointserve_sent_bytes_total"] >= 10_110
    assert figures["pointserve_reply_seconds_count"] == figures["pointserve_reply_seconds_bucket +Inf"] == 5


def test_json_log_says_bytes_and_range_also_of_what_was_cut(models: Path, model: WriteModel) -> None:
    model(size=40_000_000)

    async def run() -> None:
        async with RawConnection(url) as connection:
            await connection.ask("/david.lpc?signature=secret", "Range: bytes=5-9")
            connection.writer.write(b"GET /david.lpc HTTP/1.1\r\nHost: t\r\n\r\n")
            await connection.read_head()
            connection.writer.transport.abort()
        await ask_once(url, "/healthz")

    with serve_in_process(models, "--log", "json", "--grace", "5") as (url, process):
        asyncio.run(run())
        process.terminate()
        _, log = process.communicate(timeout=20)
    lines = [json.loads(line) for line in log.splitlines()]
    first = lines[0]
    assert (first["peer"], first["method"], first["path"]) == ("127.0.0.1", "GET", "/david.lpc")
    assert (first["status"], first["bytes"], first["range"], first["cut"]) == (206, 5, "bytes=5-9", False)
    (cut,) = [line for line in lines if line.get("cut")]
    assert 0 < cut["bytes"] < 40_000_000
    assert "secret" not in log


# TLS


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A self-signed certificate for 127.0.0.1 and its key."""
    folder = tmp_path_factory.mktemp("tls")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", folder / "key.pem", "-out", folder / "cert.pem"],
        check=True, capture_output=True,
    )  # fmt: skip
    return folder / "cert.pem", folder / "key.pem"


async def test_models_over_tls(models: Path, model: WriteModel, certificate: tuple[Path, Path]) -> None:
    data = model(size=6_000_000)
    cert, key = certificate
    client = ssl.create_default_context(cafile=cert)
    async with serve_in_loop(models, certfile=cert, keyfile=key) as url:
        assert url.startswith("https://127.0.0.1:")
        connection = RawConnection(url.replace("https", "http"))
        connection.reader, connection.writer = await asyncio.open_connection(
            connection.host, connection.port, ssl=client, limit=1 << 20
        )
        for start, stop in ((0, 65_536), (5, 5_999_999), (5_999_990, 6_000_000)):
            reply = await connection.ask("/david.lpc", f"Range: bytes={start}-{stop - 1}")
            assert reply.body == data[start:stop]
        connection.writer.close()
        with contextlib.suppress(ConnectionError, ssl.SSLError):
            await connection.writer.wait_closed()


def test_what_is_no_certificate_is_one_line(models: Path, tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    cert, key = certificate
    (tmp_path / "noise.pem").write_text("noise")
    for certfile, keyfile in ((tmp_path / "noise.pem", key), (cert, tmp_path / "absent"), (cert, None), (None, key)):
        with pytest.raises(StoreError) as caught:
            tls_context(ServeConfig(directory=models, certfile=certfile, keyfile=keyfile))
        assert "\n" not in str(caught.value)
    result = CliRunner().invoke(serve, [str(models), "--certfile", str(tmp_path / "noise.pem"), "--workers", "2"])
    assert result.exit_code == 1
    assert "PEM" in result.output


# workers


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def runs(pid: int) -> bool:
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()  # a zombie has ended
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_workers_share_the_port_come_back_and_stop_together(models: Path, model: WriteModel) -> None:
    data = model(size=24_000_000)

    async def ask_all(times: int) -> None:
        for _ in range(times):
            assert (await ask_once(url, "/david.lpc", "Range: bytes=7-8")).body == data[7:9]

    async def figures(ranges: int) -> Counter[str]:
        """Read what all workers counted, once it is so many; a reply is counted after its last byte has left."""
        async with asyncio.timeout(20):
            while True:
                reply = await ask_once(url, "/metrics")
                counted = Counter(dict(re.findall(r"^(pointserve_\S+) (\S+)$", reply.body.decode(), re.MULTILINE)))
                if (number := float(counted['pointserve_requests_total{status="206"}'])) >= ranges:
                    assert number == ranges
                    return counted

    async def stop_while_reading() -> None:
        async with RawConnection(url) as reading:
            reading.writer.write(b"GET /david.lpc HTTP/1.1\r\nHost: t\r\n\r\n")
            await reading.read_head()
            process.send_signal(signal.SIGTERM)
            assert await reading.reader.readexactly(len(data)) == data

    with serve_in_process(models, "--workers", "2") as (url, process):
        before = children(process.pid)
        assert len(before) == 2
        asyncio.run(ask_all(10))
        asyncio.run(figures(10))
        os.kill(before[0], signal.SIGKILL)
        deadline = time.monotonic() + 20
        while len(now := children(process.pid)) < 2 or before[0] in now:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        asyncio.run(ask_all(10))
        after = asyncio.run(figures(20))  # they outlive their worker
        assert float(after["pointserve_workers"]) == 2
        asyncio.run(stop_while_reading())
        out, log = process.communicate(timeout=20)
    assert process.returncode == 0
    assert out == ""
    assert "worker 0 died" in log
    assert "Traceback" not in log
    assert not any(Path(f"/proc/{worker}").exists() for worker in now)


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_stop_waits_no_longer_than_its_grace(models: Path, model: WriteModel, workers: str) -> None:
    model(size=40_000_000)

    async def stop_while_stalled() -> None:
        async with RawConnection(url) as stalled:
            stalled.writer.write(b"GET /david.lpc HTTP/1.1\r\nHost: t\r\n\r\n")
            await stalled.read_head()
            process.send_signal(signal.SIGTERM)
            await asyncio.to_thread(process.wait, 20)

    with serve_in_process(models, "--workers", workers, "--grace", "0.3", "--log", "json") as (url, process):
        asyncio.run(stop_while_stalled())
        _, log = process.communicate(timeout=20)
    assert process.returncode == 0
    (line,) = [json.loads(line) for line in log.splitlines()]
    assert line["cut"]
    assert 0 < line["bytes"] < 40_000_000


def test_workers_leave_when_their_supervisor_is_killed(models: Path, model: WriteModel) -> None:
    model()
    with serve_in_process(models, "--workers", "2", "--quiet") as (_, process):
        workers = children(process.pid)
        process.kill()
        deadline = time.monotonic() + 20
        while any(map(runs, workers)):
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_two_servers_do_not_share_a_port_by_accident(models: Path) -> None:
    with serve_in_process(models, "--workers", "2") as (url, _):
        port = url.rpartition(":")[2]
        for workers in ("1", "2"):
            result = CliRunner().invoke(serve, [str(models), "--port", port, "--workers", workers])
            assert result.exit_code == 1
            assert "is in use" in result.output


async def test_a_folder_has_its_own_catalogue(models: Path, model: WriteModel) -> None:
    model("top.lpc")
    make_model(models / "halls" / "north" / "deep.lpc")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for folder, listed in (("/", 2), ("/halls/", 1), ("/halls/north/", 1)):
            reply = await connection.ask(folder + "catalogue.json")
            assert len(json.loads(reply.body)["models"]) == listed
            assert b"deep.lpc" in (await connection.ask(folder)).body
        for absent in ("/hall/", "/halls/north/deep.lpc/", "/.x/", "/../", "/halls//"):
            assert (await connection.ask(absent)).status == 404
            assert (await connection.ask(absent + "catalogue.json")).status == 404


@pytest.mark.parametrize("arguments", [["--rate", "fast"], ["--rate", "0"], ["--workers", "0"], ["--log", "xml"]])
def test_wrong_values_exit_2(arguments: list[str]) -> None:
    assert CliRunner().invoke(serve, [".", *arguments]).exit_code == 2
