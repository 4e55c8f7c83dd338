from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import pytest

from lpc.errors import Corrupt, NotFound
from pointstream import __version__, command

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).resolve().parents[2]


class Point:
    """An entry point whose import does what the test says."""

    def __init__(self, name: str, load: Callable[[], Any]) -> None:
        self.name, self.load, self.value = name, load, f"somewhere:{name}"


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Install commands: the keyword is the name, the value runs as the command's body."""

    def install(**bodies: Callable[[], Any]) -> None:
        def command_of(name: str, body: Callable[[], Any]) -> Callable[[], click.Command]:
            return lambda: click.Command(name, callback=body, params=[click.Option(["--size"], type=int)])

        points = [Point(name, command_of(name, body)) for name, body in bodies.items()]
        monkeypatch.setattr(command, "entry_points", lambda group: points if group == command.GROUP else [])

    return install


def raising(error: BaseException) -> Callable[..., None]:
    def body(**_: object) -> None:
        raise error

    return body


def test_the_table_of_help_lines_names_the_commands_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(command.SUMMARIES) == set(project["entry-points"][command.GROUP])
    assert set(command.EXTRAS) <= set(command.SUMMARIES)
    named = {extra for extras in command.EXTRAS.values() for extra in extras.split(",")}
    assert named | {"client"} <= set(project["optional-dependencies"])
    assert project["scripts"]["pointstream"] == "pointstream.command:main"


def test_help_lists_everything_and_imports_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load() -> None:
        raise AssertionError("imported")

    points = [Point(name, load) for name in ("zebra", "info", "build")]
    monkeypatch.setattr(command, "entry_points", lambda group: points)
    assert command.run(["--help"]) == 0
    out = capsys.readouterr().out
    assert out.index("build") < out.index("info ") < out.index("zebra")
    assert command.SUMMARIES["build"] in out


def test_the_script_starts_without_the_heavy_packages() -> None:
    code = (
        "import sys; from pointstream.command import run; status = run(['--help']); "
        "heavy = {'numpy', 'httpx', 'aiohttp', 'numba', 'rich'} & sys.modules.keys(); "
        "sys.exit(str(heavy) if heavy else status)"
    )
    path = ":".join(str(ROOT / folder) for folder in ("common", "server", "client"))
    done = subprocess.run(
        [sys.executable, "-c", code], env={"PYTHONPATH": path}, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: pointstream" in done.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["--version"]) == 0
    assert capsys.readouterr().out == f"pointstream, version {__version__}\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (Corrupt("page 3: checksum differs,\nthe file is damaged"), "page 3: checksum differs, the file is damaged"),
        (NotFound("no model at x.lpc"), "no model at x.lpc"),
        (PermissionError(13, "Permission denied", "/x/y"), "Permission denied: /x/y"),
        (OSError("odd"), "odd"),
        (MemoryError(), "not enough memory; ask for less at once, or lower --memory or --budget"),
        (click.ClickException("said by click"), "said by click"),
        (
            ModuleNotFoundError("No module named 'laspy.lib'", name="laspy.lib"),
            "`info` needs laspy, which is not installed: pip install 'pointstream[client]'",
        ),
    ],
)
def test_a_failure_is_one_line_and_status_1(
    offer: Callable[..., None], capsys: pytest.CaptureFixture[str], error: Exception, line: str
) -> None:
    offer(info=raising(error))
    assert command.run(["info"]) == 1
    captured = capsys.readouterr()
    assert captured.err == f"pointstream: {line}\n"
    assert captured.out == ""


@pytest.mark.parametrize("arguments", [["bogus"], ["info", "--bogus"], ["info", "--size", "x"], ["info", "extra"]])
def test_wrong_arguments_are_status_2(
    offer: Callable[..., None], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    offer(info=lambda size: None)
    assert command.run(arguments) == 2
    captured = capsys.readouterr()
    place = "pointstream info" if arguments[0] == "info" else "pointstream"
    assert re.fullmatch(rf"pointstream: [^\n]+; see '{place} --help'\n", captured.err)
    assert captured.out == ""


def test_no_command_shows_the_help(offer: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    offer(info=lambda size: None)
    assert command.run([]) == 2
    assert "Usage: pointstream" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "extra"), [("build", "server"), ("stream", "client"), ("other", "client")])
def test_a_package_that_cannot_be_imported_names_its_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, extra: str
) -> None:
    point = Point(name, raising(ModuleNotFoundError("No module named 'numba'", name="numba")))
    monkeypatch.setattr(command, "entry_points", lambda group: [point])
    assert command.run([name]) == 1
    expected = f"pointstream: `{name}` needs numba, which is not installed: pip install 'pointstream[{extra}]'\n"
    assert capsys.readouterr().err == expected


def test_a_broken_package_of_ours_is_not_blamed_on_an_extra(offer: Callable[..., None]) -> None:
    offer(info=raising(ModuleNotFoundError("No module named 'lpc.gone'", name="lpc.gone")))
    with pytest.raises(ModuleNotFoundError, match=r"lpc\.gone"):
        command.run(["info"])


def test_a_bug_keeps_its_traceback(offer: Callable[..., None]) -> None:
    offer(info=raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        command.run(["info"])


def test_status_of_success_of_no_and_of_an_interrupt(
    offer: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def no(**_: object) -> None:
        click.get_current_context().exit(1)

    offer(good=lambda size: "any value", no=no, stop=raising(KeyboardInterrupt()), abort=raising(click.Abort()))
    assert command.run(["good"]) == 0
    assert command.run(["no"]) == 1
    assert command.run(["stop"]) == 130
    assert command.run(["abort"]) == 130
    assert capsys.readouterr().err.count("pointstream: interrupted\n") == 2


def test_a_reader_that_goes_away_is_no_traceback() -> None:
    code = (
        "import click, pointstream.command as c\n"
        "def body():\n"
        "    for number in range(100_000): click.echo('line %d' % number)\n"
        "class Point:\n"
        "    name, value = 'info', 'x:y'\n"
        "    def load(self): return click.Command('info', callback=body)\n"
        "c.entry_points = lambda group: [Point()]\n"
        "import sys; sys.argv[1:] = ['info']; c.main()\n"
    )
    path = ":".join(str(ROOT / folder) for folder in ("common", "server", "client"))
    with subprocess.Popen(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "line 0\n"
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=60) == 1
    assert errors == ""
