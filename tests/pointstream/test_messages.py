"""What goes wrong is told in one line that names the file or address, whichever way the model is opened."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.frames import whole_index
from support.servers import serve_in_thread

import pointstream
from lpc.errors import LpcError
from pointstream import command
from pointstream.cli import crs_name

if TYPE_CHECKING:
    from collections.abc import Callable


def damaged(model: bytes, node: int) -> bytes:
    place = whole_index(model).cloud_range(node)
    broken = bytearray(model)
    broken[place.start + 9] ^= 0x20
    return bytes(broken)


DATA = Path(__file__).parents[1] / "data"
KINDS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "stranger": (lambda model: b"ply\nformat ascii 1.0\n" * 100, "no .lpc file"),
    "checksum": (lambda model: model[:40] + bytes([model[40] ^ 1]) + model[41:], "header: "),
    "short": (lambda model: model[:100], "ends"),
    "older": (lambda _: (DATA / "version1.lpc").read_bytes(), "version 1, this program reads 2: build the model again"),
    "newer": (lambda model: model[:8] + b"\3" + model[9:], "version 3, this program reads 2: update it"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("words", [["info"], ["verify"], ["export", "out.ply"], ["render", "out.png"]])
def test_a_bad_start_is_told_with_the_path(
    kind: str, words: list[str], model: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make, text = KINDS[kind]
    path = tmp_path / "bad.lpc"
    path.write_bytes(make(model))
    more = [str(tmp_path / word) for word in words[1:]]
    assert command.run([words[0], str(path), *more]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith(f"pointstream: {path}: "), captured.err
    assert captured.err.count(str(path)) == captured.err.count("\n") == 1
    assert text in captured.err
    assert captured.out == ""
    with pytest.raises(LpcError, match=str(path)):
        pointstream.open(str(path))


def test_a_damaged_cloud_is_told_with_the_path(
    model: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.lpc"
    path.write_bytes(damaged(model, 8))
    with pointstream.open(str(path)) as opened, pytest.raises(LpcError, match=f"{path}: cloud 8: "):
        opened.read()
    assert command.run(["export", str(path), str(tmp_path / "out.ply")]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"pointstream: {path}: cloud 8: ")
    assert command.run(["render", str(path), str(tmp_path / "out.png"), "--size", "200x200", "--tolerance", "0.1"]) == 0
    assert f"pointstream: {path}: cloud 8: " in capsys.readouterr().err


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_no_of_verify_is_one_line(
    form: list[str], model: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bad.lpc"
    path.write_bytes(damaged(damaged(model, 8), 11))
    assert command.run(["verify", str(path), *form]) == 1
    captured = capsys.readouterr()
    told = [line for line in captured.err.splitlines() if line.startswith("pointstream: ")]
    assert told == [captured.err.splitlines()[-1]]
    assert told[0].startswith(f"pointstream: {path}: cloud 8: ")
    assert "(and " in told[0]
    if form:
        assert "cloud 11: " in " ".join(json.loads(captured.out)["problems"])
    else:
        assert "problem: cloud 11: " in captured.out


def test_an_address_is_told_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve_in_thread(tmp_path) as url:
        assert command.run(["info", f"{url}/folder/none.lpc"]) == 1
    assert capsys.readouterr().err.startswith(f"pointstream: {url}/folder/none.lpc: there is no such file (status 404)")


@pytest.mark.parametrize("target", ["ftp://x/y.lpc", "s3://bucket/y.lpc", "file:///tmp/y.lpc"])
def test_other_addresses_are_no_paths(target: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["info", target]) == 1
    assert capsys.readouterr().err == (
        f"pointstream: {target}: only http and https addresses and paths of files work\n"
    )


def test_link_tells_as_all_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["link", "tcp://127.0.0.1:1", "--profile", "adsl"]) == 1
    assert capsys.readouterr().err.startswith("pointstream: cannot connect to 127.0.0.1:1")


UTM = (
    'PROJCRS["WGS 84 / UTM zone 10N",BASEGEOGCRS["WGS 84",DATUM["World",ELLIPSOID["WGS 84",6378137,298.25]],'
    'ID["EPSG",4326]],CONVERSION["x",METHOD["TM",ID["EPSG",9807]]],CS[Cartesian,2],ID["EPSG",32610]]'
)
OLD = 'PROJCS["NAD83 / UTM zone 16N",GEOGCS["NAD83",AUTHORITY["EPSG","4269"]],AUTHORITY["EPSG","26916"]]'


@pytest.mark.parametrize(
    ("wkt", "name"),
    [
        (UTM, "WGS 84 / UTM zone 10N (EPSG:32610)"),
        (OLD, "NAD83 / UTM zone 16N (EPSG:26916)"),
        (
            f'COMPD_CS["both",{OLD},VERT_CS["NAVD88",VERT_DATUM["d",2005,AUTHORITY["EPSG","5103"]],AUTHORITY["EPSG","5703"]]]',
            "both (EPSG:26916+5703)",
        ),
        ('LOCAL_CS["site ""A"" [old]",UNIT["metre",1,AUTHORITY["EPSG","9001"]]]', 'site "A" [old]'),
        ("no text of a system", "no text of a system"),
    ],
)
def test_a_coordinate_system_by_its_name(wkt: str, name: str) -> None:
    assert crs_name(wkt) == name


def test_info_for_people_is_short(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import time

    import numpy as np

    from pointbuild import BuildOptions, build_model

    rng = np.random.default_rng(0)
    for name in "ab":
        extra = {"fuel": rng.random(50), "heat": rng.random(50)} if name == "a" else {}
        np.savez(tmp_path / f"{name}.npz", xyz=rng.random((50, 3)), **extra)
    options = BuildOptions(attributes=("all",))
    build_model([tmp_path / "a.npz", tmp_path / "b.npz"], tmp_path / "m.lpc", options, clock=time.monotonic)
    assert command.run(["info", str(tmp_path / "m.lpc")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert len(lines) == 1
    assert "fuel, heat: " in lines[0]
