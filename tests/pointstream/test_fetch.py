"""Offline copies: whole ones are the origin's bytes, parts open as models, interrupted ones go on."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.frames import subtrees, whole_index
from support.hosts import origin_of, virtual_store
from support.servers import REPOSITORY, serve_in_thread

import pointstream
from lpc.errors import LpcError, StoreError, Unavailable
from lpc.header import HEADER_PROBE, parse_header
from lpc.page import page_bytes
from pointlink import virtual
from pointlink.faults import Flip, Reset
from pointlink.profiles import ADSL
from pointstream import command
from pointstream.fetch import FetchOptions, FetchReport, copy_name, fetch
from pointstream.reading import Reader, Region
from pointstream.stores import open_store
from pointstream.stores.sparse import SparseFile, map_path
from pointstream.verify import VerifyReport, verify

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pointlink.origin import Origin


def copy(origin: Origin, out: Path, **options: Any) -> FetchReport:
    async def main() -> FetchReport:
        async with virtual_store(origin) as store:
            return await fetch(store, out, FetchOptions(**options))

    return virtual.run(main())


def verified(path: Path) -> VerifyReport:
    async def main() -> VerifyReport:
        store = open_store(str(path), clock=time.monotonic)
        try:
            return await verify(await Reader.open(store))
        finally:
            await store.close()

    return asyncio.run(main())


def asked(origin: Origin) -> int:
    return sum(exchange.stop - exchange.start for exchange in origin.log)


def test_a_whole_copy_is_the_origins_bytes(model: bytes, tmp_path: Path) -> None:
    out, origin = tmp_path / "folder" / "model.lpc", origin_of(model)
    report = copy(origin, out)
    assert out.read_bytes() == model
    assert [path.name for path in out.parent.iterdir()] == ["model.lpc"]
    assert (report.complete, report.bytes, report.clouds) == (True, len(model), report.clouds_total)
    assert report.bytes_fetched == len(model), "what the opening brought too"
    again = origin_of(model)
    assert copy(again, out).bytes_fetched == 0
    assert asked(again) == parse_header(model).page0


def test_a_region_is_a_model_that_has_every_sample_of_the_region(model: bytes, tmp_path: Path) -> None:
    out, origin = tmp_path / "part.lpc", origin_of(model)
    box = (499_990.0, 3_999_990.0, 110.0, 500_000.0, 4_000_000.0, 121.0)
    report = copy(origin, out, region=Region(bounds=box))
    assert not report.complete
    assert report.bytes < 0.9 * len(model)
    (tmp_path / "whole.lpc").write_bytes(model)
    with pointstream.open(str(tmp_path / "whole.lpc")) as whole, pointstream.open(str(out)) as part:
        here = {"samples": len(part.read()), "clouds": part.info["here"]["clouds"]}
        assert part.info == {**whole.info, "complete": False, "here": here}
        assert 0 < here["clouds"] < whole.info["clouds"]
        right, mine = whole.read(bounds=box), part.read(bounds=box)
        assert (mine.xyz == right.xyz).all()
        assert 0 < len(mine) < len(part.read()) < len(whole.read())
    assert command.run(["verify", str(out)]) == 1
    rest = origin_of(model)
    completed = copy(rest, out)
    assert (completed.complete, completed.bytes_fetched) == (True, len(model) - report.bytes)
    assert out.read_bytes() == model
    assert not map_path(out).exists()
    assert asked(rest) < len(model), "what was here is fetched again"


def test_a_budget_keeps_the_coarsest(model: bytes, tmp_path: Path) -> None:
    report = copy(origin_of(model), tmp_path / "part.lpc", most_bytes=80_000)
    assert 70_000 < report.bytes <= 80_000
    spacing = parse_header(model).spacing * 4
    report = copy(origin_of(model), tmp_path / "coarse.lpc", region=Region(spacing=spacing))
    (tmp_path / "whole.lpc").write_bytes(model)
    with pointstream.open(str(tmp_path / "whole.lpc")) as whole, pointstream.open(str(tmp_path / "coarse.lpc")) as part:
        assert (part.read(spacing=spacing).xyz == whole.read(spacing=spacing).xyz).all()
        assert len(part.read()) < len(whole.read())


@pytest.mark.parametrize("bounds", [None, (499_990.0, 3_999_990.0, 110.0, 500_000.0, 4_000_000.0, 121.0)])
def test_a_copy_never_holds_more_than_was_asked_for(model: bytes, tmp_path: Path, bounds: Any) -> None:
    """Whatever brought it: the first request brings clouds too, and ones outside the bounds."""
    header, out = parse_header(model), tmp_path / "part.lpc"
    whole = copy(origin_of(model), tmp_path / "all.lpc", region=Region(bounds=bounds)).bytes
    least = header.page0 + page_bytes(header, 0)
    for most in (least, 12_000, 40_000, 70_000, 90_000, 120_000):  # each goes on with the copy of the one before
        report = copy(origin_of(model), out, most_bytes=most, region=Region(bounds=bounds))
        assert min(most - 7_000, whole) <= report.bytes <= most
        with closing(SparseFile(out, length=len(model), tag=header.tag, writable=False)) as file:
            assert file.present.total == report.bytes
        with pointstream.open(str(out)) as part:
            assert part.info["here"]["clouds"] == report.clouds
    assert copy(origin_of(model), out, most_bytes=12_000).bytes == report.bytes, "what is there stays"
    with pytest.raises(StoreError, match=f"header and first page alone take {least:,}"):
        copy(origin_of(model), tmp_path / "none.lpc", most_bytes=least - 1)


def test_a_budget_reads_no_more_of_the_index_than_it_can_use(model: bytes, tmp_path: Path) -> None:
    origin = origin_of(model)
    copy(origin, tmp_path / "part.lpc", most_bytes=10_000)
    assert asked(origin) <= HEADER_PROBE


@pytest.mark.parametrize("share", [0.01, 0.02, 0.4, 0.9])
def test_of_a_file_that_is_cut_short_all_is_copied_and_it_is_said(
    share: float, model: bytes, tmp_path: Path, capsys: Any
) -> None:
    cut_short = tmp_path / "model.lpc"
    cut_short.write_bytes(model[: int(share * len(model))])
    assert command.run(["fetch", str(cut_short), str(tmp_path / "copy"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["cut_short"], report["complete"]) == (True, False)
    with pointstream.open(str(cut_short)) as here, pointstream.open(str(tmp_path / "copy" / "model.lpc")) as there:
        assert here.info == there.info
        assert report["clouds"] == here.info["here"]["clouds"]
    assert command.run(["fetch", str(cut_short), str(tmp_path / "copy")]) == 0
    assert (
        f"{report['clouds']} of {report['clouds_total']} clouds of a file that is cut short" in capsys.readouterr().out
    )


def test_an_interruption_costs_only_what_was_on_its_way(large_model: bytes, tmp_path: Path) -> None:
    out, first = tmp_path / "model.lpc", origin_of(large_model)

    async def main() -> None:
        async with virtual_store(first, ADSL) as store:
            task = asyncio.create_task(fetch(store, out))
            await asyncio.sleep(2.5)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    virtual.run(main())
    with pointstream.open(str(out)) as part:
        assert not part.info["complete"]
        assert len(part.read()) > 0
    second = origin_of(large_model)
    report = copy(second, out)
    assert report.complete
    assert out.read_bytes() == large_model
    assert asked(second) < 0.7 * len(large_model)


def test_an_outage_is_waited_out_and_a_dead_host_is_told(model: bytes, tmp_path: Path) -> None:
    origin = origin_of(model)
    origin.fault = lambda number: Reset() if number >= 2 and asyncio.get_running_loop().time() < 30 else None
    assert copy(origin, tmp_path / "a.lpc").complete
    with pytest.raises(Unavailable, match="run the same command again"):
        copy(origin_of(model, lambda number: Reset() if number >= 2 else None), tmp_path / "b.lpc")
    assert copy(origin_of(model), tmp_path / "b.lpc").complete


def test_damage_on_the_line_never_reaches_the_copy(model: bytes, tmp_path: Path) -> None:
    out = tmp_path / "model.lpc"
    assert copy(origin_of(model, lambda number: Flip(at=900) if number % 3 == 1 else None), out).complete
    assert out.read_bytes() == model


def test_a_cloud_damaged_at_its_origin_is_told_and_left_out(model: bytes, tmp_path: Path) -> None:
    out, damaged = tmp_path / "model.lpc", bytearray(model)
    damaged[-20] ^= 1
    report = copy(origin_of(bytes(damaged)), out)
    assert not report.complete
    assert len(report.problems) == 1
    assert report.clouds == report.clouds_total - 1
    with pointstream.open(str(out)) as part:
        assert len(part.read()) < part.header.samples


def test_what_a_damaged_cloud_tells_is_copied_and_neither_read_nor_taken_for_damaged(
    model: bytes, tmp_path: Path
) -> None:
    out, index, damaged = tmp_path / "model.lpc", whole_index(model), bytearray(model)
    damaged[index.offset[2] + 15] ^= 2
    report = copy(origin_of(bytes(damaged)), out)
    assert [text.split(":")[0] for text in report.problems] == ["cloud 2"]
    assert report.clouds == report.clouds_total - 1
    untold = subtrees(index, [2])
    with pointstream.open(str(out)) as part:
        assert len(part.read()) == part.header.samples - int(index.samples[untold].sum())
    copied = verified(out)
    assert copied.clouds_checked == report.clouds
    assert f"{len(untold) - 1} sound clouds of " in copied.problems[1]


@pytest.mark.parametrize("there", ["other build", "foreign", "folder"])
def test_what_stands_in_the_way_is_not_touched(there: str, model: bytes, other_model: bytes, tmp_path: Path) -> None:
    out = tmp_path / "model.lpc"
    match there:
        case "other build":
            out.write_bytes(other_model)
        case "foreign":
            out.write_bytes(b"a letter")
        case "folder":
            out.mkdir()
    before = out.read_bytes() if out.is_file() else None
    with pytest.raises(StoreError, match=r"another (build|folder)"):
        copy(origin_of(model), out)
    assert (out.read_bytes() if out.is_file() else None) == before


def test_an_index_that_is_not_that_of_its_build_id_is_refused(model: bytes, tmp_path: Path) -> None:
    """Sound pages, sound clouds, and a header of another seed under the old digest."""
    import zlib

    length = int.from_bytes(model[12:16], "little")
    text = model[24 : 24 + length].replace(b'"seed":3', b'"seed":4')
    assert text != model[24 : 24 + length]
    forged = model[:16] + zlib.crc32(text).to_bytes(4, "little") + model[20:24] + text + model[24 + length :]
    with pytest.raises(LpcError, match="build id"):
        copy(origin_of(forged), tmp_path / "model.lpc")


@pytest.mark.parametrize(
    ("target", "name"),
    [
        ("http://h/a/model.lpc?x=1#y", "model.lpc"),
        ("http://h/", "model.lpc"),
        ("http://h/a/%2e%2e", "model.lpc"),
        ("http://h/a%2Fb%00.lpc", "b.lpc"),
        ("/some/where/x.lpc", "x.lpc"),
        ("..\\x.lpc", "x.lpc"),
    ],
)
def test_names_of_copies_stay_in_their_folder(target: str, name: str) -> None:
    assert copy_name(target) == name


@pytest.fixture
def hosted(model: bytes, tmp_path: Path) -> Iterator[str]:
    (tmp_path / "www").mkdir()
    (tmp_path / "www" / "model.lpc").write_bytes(model)
    with serve_in_thread(tmp_path / "www") as url:
        yield f"{url}/model.lpc"


def test_the_command_copies_and_says_so(hosted: str, model: bytes, tmp_path: Path, capsys: Any) -> None:
    assert command.run(["fetch", hosted, str(tmp_path / "copy"), "--json"]) == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert (report["complete"], report["bytes"]) == (True, len(model))
    assert "fetching bytes" in captured.err
    assert (tmp_path / "copy" / "model.lpc").read_bytes() == model
    assert command.run(["verify", str(tmp_path / "copy" / "model.lpc")]) == 0
    assert command.run(["fetch", hosted + "x", str(tmp_path / "copy")]) == 1


def test_an_interrupted_command_says_how_to_go_on(hosted: str, model: bytes, tmp_path: Path) -> None:
    paths = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "client"))
    program = "import os, signal, sys; import pointstream.reading as r; from pointstream.command import run\n"
    program += "read = r.Reader.read\n"
    program += (
        "async def cut(self, place):\n    os.kill(os.getpid(), signal.SIGINT)\n    return await read(self, place)\n"
    )
    program += "r.Reader.read = cut\nsys.exit(run(['fetch', *sys.argv[1:]]))"
    done = subprocess.run(
        [sys.executable, "-c", program, hosted, str(tmp_path / "copy")],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 128 + signal.SIGINT
    assert "the same command goes on" in done.stderr
    assert "Traceback" not in done.stderr
    assert command.run(["fetch", hosted, str(tmp_path / "copy")]) == 0
    assert (tmp_path / "copy" / "model.lpc").read_bytes() == model


def test_render_and_export_work_from_the_cache_with_the_host_gone(model: bytes, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "www").mkdir()
    (tmp_path / "www" / "model.lpc").write_bytes(model)
    cache = ["--cache", str(tmp_path / "cache")]
    render = ["render", "--size", "160x120", "--backend", "cpu", "--json", *cache]
    with serve_in_thread(tmp_path / "www") as url:
        address = f"{url}/model.lpc"
        assert command.run([*render, address, str(tmp_path / "a.png")]) == 0
        assert command.run(["export", *cache, address, str(tmp_path / "a.npz")]) == 0
    capsys.readouterr()
    assert command.run([*render, address, str(tmp_path / "b.png")]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["bytes_read"] == 0
    assert "does not answer" in captured.err
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert command.run(["export", *cache, address, str(tmp_path / "b.npz")]) == 0
    with np.load(tmp_path / "a.npz") as one, np.load(tmp_path / "b.npz") as other:
        assert (one["xyz"] == other["xyz"]).all()
    assert command.run(["export", "--cache", "none", address, str(tmp_path / "c.npz")]) == 1


def test_a_copy_that_has_no_page_yet_is_a_model_without_samples(model: bytes, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "model.lpc").write_bytes(model[: parse_header(model).page0 + 100])
    assert command.run(["fetch", str(tmp_path / "model.lpc"), str(tmp_path / "copy")]) == 0
    out = str(tmp_path / "copy" / "model.lpc")
    capsys.readouterr()
    assert command.run(["info", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["here"] == {"samples": 0, "clouds": 0}
    assert command.run(["render", out, str(tmp_path / "a.png"), "--size", "32x32", "--backend", "cpu"]) == 0
    assert command.run(["export", out, str(tmp_path / "a.ply")]) == 0
