"""info, verify and export from the command line, as scripts see them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from oracles.build import build_bytes
from support.servers import serve_in_thread

import pointstream
from lpc.points import PointBatch
from pointstream import command

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, model: bytes) -> Path:
    file = tmp_path_factory.mktemp("models") / "model.lpc"
    file.write_bytes(model)
    return file


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = command.run([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_info_is_one_json_object_here_and_over_http(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "info", path, "--json")
    assert (status, err) == (0, "")
    facts = json.loads(out)
    assert facts["samples"] == 20_000
    with serve_in_thread(path.parent) as url:
        assert json.loads(run(capsys, "info", f"{url}/model.lpc", "--json")[1]) == facts


def test_info_for_people_names_what_counts(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "info", path)
    assert status == 0
    assert "20,000 in" in out
    assert "normal, color, intensity" in out


def test_one_thing_is_not_told_as_many(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "one.lpc").write_bytes(build_bytes(PointBatch(np.arange(24.0).reshape(8, 3), {})))
    assert "8 in 1 cloud of at most" in run(capsys, "info", tmp_path / "one.lpc")[1]
    assert "1 of 1 cloud checked" in run(capsys, "verify", tmp_path / "one.lpc")[1]


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["info", "nothing.lpc"], 1, "there is no such file"),
        (["info", "http://127.0.0.1:9/"], 1, "gave up after 4 tries"),
        (["verify"], 2, "MODEL"),
        (["export", "MODEL", "out.ply", "--bounds", "1,2,3"], 2, "X0,Y0,Z0"),
        (["export", "MODEL", "out.ply", "--bounds", "1,1,1,0,2,2"], 2, "X0 <= X1"),
        (["export", "MODEL", "out.ply", "--level", "1", "--spacing", "2"], 2, "not both"),
        (["export", "MODEL", "out.foo"], 2, ".npz"),
        (["export", "MODEL", "no/such/folder/out.ply"], 1, "no/such/folder"),
        (["verify", "MODEL", "stray.ply"], 2, "after --against"),
        (["verify", "MODEL", "--against", "nothing.ply"], 1, "nothing.ply"),
    ],
)
def test_bad_input_is_one_line_and_a_status(
    arguments: list[str], status: int, text: str, path: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    got, out, err = run(capsys, *(str(path) if part == "MODEL" else part for part in arguments))
    assert got == status
    assert out == ""
    assert text in err.splitlines()[-1]
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_verify_says_ok_or_what_is_wrong(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "verify", path, "--json")
    report = json.loads(out)
    assert (status, report["ok"], report["problems"]) == (0, True, [])
    (tmp_path / "cut.lpc").write_bytes(path.read_bytes()[:50_000])
    status, out, _ = run(capsys, "verify", tmp_path / "cut.lpc", "--json")
    report = json.loads(out)
    assert (status, report["ok"], report["complete"]) == (1, False, False)
    assert "cut short: 50000 of" in report["problems"][0]
    assert run(capsys, "verify", tmp_path / "cut.lpc")[0] == 1
    facts = json.loads(run(capsys, "info", tmp_path / "cut.lpc", "--json")[1])
    assert facts["complete"] is False
    assert facts["here"] == {"samples": report_samples(tmp_path / "cut.lpc"), "clouds": report["clouds_checked"]}
    assert facts["samples"] == 20_000
    out = run(capsys, "info", tmp_path / "cut.lpc")[1]
    assert f"{facts['here']['samples']:,} of the samples" in " ".join(out.split())


def report_samples(path: Path) -> int:
    with pointstream.open(str(path)) as model:
        return len(model.read())


def test_a_part_without_samples_is_no_file(path: Path, tmp_path: Path, capsys: Any) -> None:
    status, _, err = run(capsys, "export", path, tmp_path / "out.ply", "--bounds", "0,0,0,1,1,1")
    assert status == 1
    assert "no sample" in err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["ply", "npz", "laz", "xyz"])
def test_export_and_verify_close_the_circle(suffix: str, path: Path, tmp_path: Path, capsys: Any) -> None:
    """What is exported is what the model holds, for the readers of scans."""
    out = tmp_path / f"out.{suffix}"
    assert run(capsys, "export", path, out)[0] == 0
    status, text, _ = run(capsys, "verify", path, "--against", out, "--json")
    report = json.loads(text)
    assert status == 0, report["problems"]
    assert (report["samples_in"], report["samples_out"], report["missing"]) == (20_000, 20_000, 0)
    with pointstream.open(str(path)) as model:
        assert report["max_position_error"] <= (1e-3 if suffix == "xyz" else 1e-6) * model.header.position_error


def test_several_scans_follow_one_option(path: Path, tmp_path: Path, scan: PointBatch, capsys: Any) -> None:
    for name, part in (("a", slice(0, 9000)), ("b", slice(9000, 9001)), ("c", slice(9001, None))):
        piece = scan.take(part)
        np.savez(tmp_path / f"{name}.npz", xyz=piece.xyz, **piece.attributes)
    files = [tmp_path / f"{name}.npz" for name in "abc"]
    status, text, _ = run(capsys, "verify", path, "--against", *files, "--json")
    report = json.loads(text)
    assert status == 0, report["problems"]
    assert report["attributes_differing"] == {"normal": 0, "color": 0, "intensity": 0}
    status, text, _ = run(capsys, "verify", path, "--against", *files[:2], "--json")
    assert (status, json.loads(text)["samples_in"]) == (1, 9001)


def test_export_of_a_part(path: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "part.npz"
    assert run(capsys, "export", path, out, "--level", "1", "--bounds", "499990,3999990,120,500010,4000010,131")[0] == 0
    with pointstream.open(str(path)) as model, np.load(out) as arrays:
        right = model.read(level=1, bounds=[499_990, 3_999_990, 120, 500_010, 4_000_010, 131])
        assert sorted(arrays) == ["color", "intensity", "normal", "xyz"]
        assert (arrays["xyz"] == right.xyz).all()
        assert (arrays["xyz"][:, 2] >= 120).all()
        assert 0 < len(right) < 600
