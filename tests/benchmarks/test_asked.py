"""Command lines of the benchmarks: all of them say what they are about and take numbers of samples alike."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

import asked
import pytest

SCRIPTS = sorted(
    path.stem
    for path in Path(asked.__file__).parent.glob("*.py")
    if "\ndef main() " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize(
    ("text", "count"), [("10M", 10_000_000), ("200k", 200_000), ("1.5M", 1_500_000), ("2G", 2_000_000_000), ("7", 7)]
)
def test_numbers_of_samples(text: str, count: int) -> None:
    assert asked.samples(text) == count


@pytest.mark.parametrize("text", ["", "M", "10m", "-1M", "0", "nanM", "infM", "1e400M", "ten"])
def test_what_is_no_number_of_samples(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="like 200k, 10M"):
        asked.samples(text)


@pytest.mark.parametrize("name", SCRIPTS)
def test_help_says_what_a_script_is_about(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = importlib.import_module(name)
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 0
    assert script.__doc__.splitlines()[0] in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--no-such-option"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 2
