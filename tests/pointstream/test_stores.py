"""What every store must do, whatever it stands on."""

from __future__ import annotations

import asyncio
import os
import random
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.hosts import KINDS, origin_of, socket_store, with_store

from lpc.errors import ModelChanged, NotFound, StoreError
from lpc.ranges import ByteRange
from pointstream.stores import LocalStore, open_store
from pointstream.stores.http import HttpOptions, HttpStore

if TYPE_CHECKING:
    from pointstream.stores import Store

DATA = random.Random(4).randbytes(300_000)


@pytest.mark.parametrize("kind", KINDS)
def test_any_range_is_the_files(kind: str, tmp_path: Path) -> None:
    draw = random.Random(1)
    ranges = [ByteRange(0, 1), ByteRange(0, len(DATA)), ByteRange(len(DATA) - 1, len(DATA))]
    for _ in range(20):
        start, stop = sorted(draw.sample(range(len(DATA)), 2))
        ranges.append(ByteRange(start, stop))

    async def check(store: Store) -> None:
        for wanted in ranges:
            assert await store.read(wanted) == DATA[wanted.start : wanted.stop]
        assert store.length == len(DATA)
        together = await asyncio.gather(*(store.read(wanted) for wanted in ranges))
        assert together == [DATA[wanted.start : wanted.stop] for wanted in ranges]

    with_store(kind, DATA, tmp_path, check)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sink_sees_every_byte_once_in_order(kind: str, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        got = bytearray()

        def sink(offset: int, chunk: bytes) -> None:
            assert offset == 1000 + len(got)
            assert chunk
            got.extend(chunk)

        await store.read(ByteRange(1000, 90_000), sink)
        assert got == DATA[1000:90_000]

    with_store(kind, DATA, tmp_path, check)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [0, 1, 10])
def test_the_end_of_the_file_cuts_a_range_short(kind: str, length: int, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        assert await store.read(ByteRange(0, 65_536)) == DATA[:length]
        assert store.length == length
        assert await store.read(ByteRange(length, length + 5)) == b""
        if length > 1:
            assert await store.read(ByteRange(length - 1, length + 5)) == DATA[length - 1 : length]

    with_store(kind, DATA[:length], tmp_path, check)


@pytest.mark.parametrize("kind", KINDS)
def test_an_error_in_the_sink_comes_out_and_spoils_nothing(kind: str, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        def sink(offset: int, chunk: bytes) -> None:
            raise LookupError

        with pytest.raises(LookupError):
            await store.read(ByteRange(0, 5000), sink)
        assert await store.read(ByteRange(0, 5000)) == DATA[:5000]

    with_store(kind, DATA, tmp_path, check)


def test_local_files_that_cannot_be_read_are_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="no such file"):
        LocalStore(tmp_path / "nothing.lpc")
    with pytest.raises(StoreError, match="folder"):
        LocalStore(tmp_path)


def test_a_file_cut_short_while_open_is_an_error_and_no_signal(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(DATA)

    async def check() -> None:
        store = LocalStore(path)
        assert await store.read(ByteRange(0, 10)) == DATA[:10]
        os.truncate(path, 1000)
        with pytest.raises(ModelChanged, match="cut short"):
            await store.read(ByteRange(500, 2000))
        store.forget()
        assert await store.read(ByteRange(500, 2000)) == DATA[500:1000]
        await store.close()

    asyncio.run(check())


def test_targets_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "http:").mkdir()
    (tmp_path / "file.lpc").write_bytes(b"x")
    local = open_store(str(tmp_path / "file.lpc"), clock=lambda: 0.0)
    assert isinstance(local, LocalStore)
    asyncio.run(local.close())

    async def remote() -> None:
        store = open_store("HTTPS://user:secret@host.test/a.lpc", clock=lambda: 0.0)
        assert isinstance(store, HttpStore)
        assert "secret" not in store.name + repr(store)
        await store.close()
        for bad in ("http://", "http://[::1", "http:///path"):
            with pytest.raises(StoreError):
                open_store(bad, clock=lambda: 0.0)

    asyncio.run(remote())


def descriptors() -> int:
    """Open files and sockets of this process, where the system tells."""
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.is_dir() else 0


def test_cancelled_reads_leave_no_descriptor_and_no_lost_slot() -> None:
    """480 reads cut off at any moment on four connections: httpx's shared pool would be dead after this."""
    draw = random.Random(8)

    async def check() -> None:
        before = descriptors()
        async with socket_store(origin_of(DATA), HttpOptions(lanes=4)) as store:

            async def impatient() -> None:
                task = asyncio.create_task(store.read(ByteRange(0, draw.choice([10, 3000, 200_000]))))
                for _ in range(draw.randrange(40)):
                    await asyncio.sleep(0)
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

            for _ in range(20):
                await asyncio.gather(*(impatient() for _ in range(12)))
            assert await store.read(ByteRange(5, 100_000)) == DATA[5:100_000]
            assert store.meter is not None
            assert store.meter.in_flight == 0
        others = asyncio.all_tasks() - {asyncio.current_task()}
        await asyncio.gather(*others)  # the host's side notices the closed connections
        await asyncio.sleep(0)
        assert descriptors() == before

    asyncio.run(check())
