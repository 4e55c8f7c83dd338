"""`pointstream stream` from the command line: what it prints, and wrong arguments."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.frames import whole_index

from pointstream.command import run as command
from pointstream.fetch import FetchOptions, fetch
from pointstream.reading import Region
from pointstream.stores import LocalStore

REPOSITORY = Path(__file__).resolve().parents[3]
ROOMS = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client"))
ENVIRONMENT = {**os.environ, "PYTHONPATH": ROOMS}


STEP = "streaming, seconds: "


def run(*arguments):
    return command(["stream", *map(str, arguments)])


def given(folder, *, link="adsl", clock="virtual"):
    return "--report", folder, "--link", link, "--clock", clock, "--size", "64x48", "--seconds", "0.6"


def test_json_is_one_object_the_report(small, tmp_path, capsys):
    assert run(small, *given(tmp_path), "--json") == 0
    said = capsys.readouterr()
    assert said.out.count("\n") == 1
    assert json.loads(said.out) == json.loads((tmp_path / "report.json").read_text())


def test_figures_and_stages_in_plain_lines(small, tmp_path, capsys):
    assert run(small, *given(tmp_path, link="none")) == 0
    said = capsys.readouterr()
    assert [line.split("  ")[0] for line in said.out.splitlines()] == [
        "first picture", "settled", "received", "link used", "report",
    ]  # fmt: skip
    assert "no limit" in said.out
    assert "\x1b" not in said.out + said.err
    assert "streaming for 0.6 s (virtual clock)" in said.err
    assert "streaming, seconds: 1 of 1" in said.err or "comparing pictures" in said.err


def test_what_never_happened_is_said(small, tmp_path, capsys):
    assert run(small, *given(tmp_path, link="32k")) == 0
    out = capsys.readouterr().out
    assert "never" in out
    assert "not within the run" in out


@pytest.mark.parametrize(
    "wrong",
    [
        ("--link", "fast"), ("--link", "-1M"), ("--seconds", "0"), ("--seconds", "nan"), ("--seconds", "1e9"),
        ("--tolerance", "0"), ("--tolerance", "nan"), ("--tolerance", "inf"), ("--size", "12"), ("--clock", "wall"),
        ("--prefetch", "maybe"),
        ("--priority", "size"), ("--view", "absent.json"), ("--view", "VIEW", "--path", "VIEW"),
    ],
)  # fmt: skip
def test_wrong_arguments_exit_2(small, tmp_path, capsys, wrong):
    view = tmp_path / "view.json"
    view.write_text("{}")
    arguments = [str(view) if word == "VIEW" else word for word in wrong]
    assert run(small, *given(tmp_path / "report"), *arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("pointstream: ")
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize(
    ("option", "content", "why"),
    [
        ("--view", "{}", "eye must be three numbers"),
        ("--view", "[]", "not a JSON object"),
        ("--view", "{", "not JSON"),
        ("--path", "[]", "a list of at least one view"),
        ("--path", '[{"t": 0}]', "entry 0"),
        ("--path", None, "cannot be read"),
    ],
)
def test_a_wrong_view_or_path_is_one_line(small, tmp_path, capsys, option, content, why):
    path = tmp_path / "view.json"
    if content is None:
        path = tmp_path / "absent.json"
    else:
        path.write_text(content)
    assert run(small, *given(tmp_path / "report"), option, path) == 2
    assert_one_line(capsys, why)


def test_no_model_no_folder_are_one_line(small, tmp_path, capsys):
    assert run(tmp_path / "absent.lpc", *given(tmp_path / "report")) == 1
    assert_one_line(capsys, "no such file")
    (tmp_path / "text.lpc").write_text("not a model")
    assert run(tmp_path / "text.lpc", *given(tmp_path / "report")) == 1
    assert_one_line(capsys, "no .lpc file")
    (tmp_path / "file").write_text("")
    assert run(small, *given(tmp_path / "file" / "report")) == 1
    assert_one_line(capsys, "cannot be written")
    assert run(small, *given(tmp_path / "file")) == 2


def assert_one_line(capsys, why):
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if line != "drawing the whole view for comparison"]
    assert len(lines) == 1
    assert lines[0].startswith("pointstream: ")
    assert why in lines[0]


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from pointstream.command import run; run(['stream', '--help']);"
        "heavy = {'matplotlib', 'skimage', 'scipy', 'PIL', 'httpx', 'numba', 'moderngl'};"
        "print(heavy & set(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert "--priority" in done.stdout
    assert done.stderr.strip() == "set()"


def test_an_interrupt_is_one_line(endless, tmp_path):
    arguments = [*given(tmp_path, clock="real")[:-1], "16"]
    command_line = [sys.executable, "-m", "pointstream", "stream", str(endless), *map(str, arguments)]
    with subprocess.Popen(command_line, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        while not (line := process.stderr.readline()).startswith(STEP):
            assert line, "the run ended before its first quarter"
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read().splitlines()
    assert process.returncode == 130
    assert rest.pop() == "pointstream: interrupted"
    assert not [line for line in rest if line and not line.startswith(STEP)], "a busy machine is another step further"


@pytest.mark.parametrize("clock", ["real", "virtual"])
def test_the_copy_of_a_part(small, tmp_path, capsys, clock):
    """No host serves one; without a link what is here is shown, and no gap taken for damage."""
    asked = Region(level=1)

    async def fetch_part():
        return await fetch(LocalStore(Path(small)), tmp_path / "part.lpc", FetchOptions(region=asked))

    assert not asyncio.run(fetch_part()).complete
    assert run(tmp_path / "part.lpc", *given(tmp_path / "report", clock=clock)) == 1
    assert "is the copy of a part" in capsys.readouterr().err
    if clock == "real":
        assert run(tmp_path / "part.lpc", *given(tmp_path / "report", clock=clock, link="none"), "--json") == 0
        assert json.loads(capsys.readouterr().out)["errors"] == []


def test_damage_is_told_also_where_the_comparison_lacks_it(small, tmp_path, capsys):
    """The curve of a damaged model is against pictures with the same hole: it must not look like a perfect one."""
    data = bytearray(Path(small).read_bytes())
    place = whole_index(bytes(data)).cloud_range(1)
    data[place.start + 9] ^= 0x20
    broken = tmp_path / "broken.lpc"
    broken.write_bytes(data)
    assert run(broken, *given(tmp_path / "report", link="none")) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pointstream: ")]
    over_the_link, compared_with = told
    assert "cloud 1: " in over_the_link
    assert compared_with.startswith("pointstream: the pictures that the curve compares with lack data too: ")
    assert f"{broken}: cloud 1: " in compared_with
    assert json.loads((tmp_path / "report" / "report.json").read_text())["errors"] == [
        line.removeprefix("pointstream: ") for line in told
    ]
