"""Numbers that cannot be meant, in every option of every command: status 2 and one line, before anything is done."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

import click
import pytest

from pointstream import command

if TYPE_CHECKING:
    from collections.abc import Iterator

HUGE = "1" + 30 * "0"
ABSURD = ("nan", "inf", "-inf", "-1", "1e400", HUGE, "", "x")
TEXTS = {
    "--memory",
    "--position-error",
    "--link",
    "--profile",
    "--rate",
    "--bounds",
    "--size",
    "--expires",
    "--worker-memory",
}
"""Options of numbers with units or commas, which click does not know to be numbers."""
REQUIRED = {"-o": "out.lpc", "--link": "adsl", "--profile": "adsl", "--report": "report", "--sign-key": "key"}
ARGUMENTS = {
    "scans": ["scan.ply"],
    "model": ["m.lpc"],
    "out": ["out.png"],
    "folder": ["copies"],
    "upstream": ["tcp://h:1"],
}


def commands() -> dict[str, click.Command]:
    return {point.name: point.load() for point in sorted(entry_points(group=command.GROUP))}


def is_number(option: click.Option) -> bool:
    return isinstance(option.type, click.types.IntParamType | click.types.FloatParamType) or bool(
        TEXTS & {*option.opts}
    )


def cases() -> Iterator[tuple[str, str]]:
    for name, found in commands().items():
        for option in found.params:
            if isinstance(option, click.Option) and is_number(option):
                yield name, option.opts[-1]


def rest_of(found: click.Command, but: str) -> list[str]:
    """All that the command needs besides the option."""
    words = []
    for item in found.params:
        if isinstance(item, click.Argument) and item.required:
            words += (
                ["out.ply"] if (found.name, item.name) == ("export", "out") else ARGUMENTS.get(item.name or "", ["x"])
            )
        elif item.required and but not in item.opts:
            words += next([opt, REQUIRED[opt]] for opt in item.opts if opt in REQUIRED)
    return words


def test_there_are_numbers_to_try() -> None:
    found = set(cases())
    assert {
        ("export", "--spacing"),
        ("render", "--tolerance"),
        ("build", "--position-error"),
        ("serve", "--grace"),
    } <= found
    assert len(found) > 25


@pytest.mark.parametrize(("name", "option"), list(cases()), ids=lambda value: value)
def test_an_absurd_number_is_wrong(
    name: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = commands()[name]

    def body(**_: object) -> None:
        raise AssertionError("the command ran")

    values = list(ABSURD)
    kind = next(item.type for item in found.params if option in item.opts)
    if option == "--seed":
        values.remove("-1")  # any 64 bits are a seed
    if option == "--position-error" or (isinstance(kind, click.FloatRange) and kind.max is None):
        values.remove(HUGE)  # a length or a time may be as large as it likes
    lazily_read = option in ("--link", "--memory", "--position-error", "--worker-memory")
    if not lazily_read:  # those are read in the command's body, before anything else
        monkeypatch.setattr(found, "callback", body)
    for value in values:
        status = command.run([name, *rest_of(found, option), f"{option}={value}"])
        captured = capsys.readouterr()
        assert status == 2, (value, captured.err)
        assert captured.err.count("\n") == 1, value
        assert captured.err.startswith("pointstream: "), value
        assert captured.out == ""
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("bounds", ["0,0,0,1,1,nan", "nan,0,0,1,1,1", "-inf,0,0,1,1,1", "0,0,0,inf,inf,inf"])
def test_bounds_are_finite(bounds: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["export", "m.lpc", "out.ply"], ["fetch", "m.lpc", "copies"]):
        assert command.run([*words, f"--bounds={bounds}"]) == 2
        assert "finite" in capsys.readouterr().err


@pytest.mark.parametrize("out", ["m.ply", "M.LAZ", "m.xyz", "m.npz"])
def test_a_model_does_not_get_the_name_of_a_scan(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(out).write_text("precious")
    assert command.run(["build", "scan.ply", "-o", out]) == 2
    assert capsys.readouterr().err.startswith(f"pointstream: {out} is the name of a scan")
    assert Path(out).read_text() == "precious"


@pytest.mark.parametrize("out", ["m.docx", "m", "m.lpc", "m.png.txt"])
def test_a_picture_has_the_suffix_of_one(out: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["render", "m.lpc", out]) == 2
    assert "the suffix says the format; use one of .png, .jpg" in capsys.readouterr().err
