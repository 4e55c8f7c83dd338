"""A real window on a display in memory, with a hand at it; and a session over a slow line, with its I/O counted."""

from __future__ import annotations

import io
import itertools
import json
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from oracles import surfaces
from oracles.build import build_bytes
from PIL import Image
from support.display import REPOSITORY, Hand, display, need_display, until, viewing
from support.servers import serve_in_thread

from pointview.stream.path import ViewPath

pytest.importorskip("imgui_bundle")
pytest.importorskip("glfw")


@pytest.fixture
def screen():
    need_display()
    with display() as name:
        yield name


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    data = build_bytes(surfaces.torus(40_000, color=True), cloud_size=512, page_nodes=32, spacing=0.02)
    path = tmp_path_factory.mktemp("models") / "torus.lpc"
    path.write_bytes(data)
    return path


def test_a_hand_at_the_window(screen, model_file, tmp_path):
    """Opens, orbits, zooms, jumps, resizes, records, takes pictures, closes."""
    hand = Hand(screen)

    numbers = itertools.count(1)

    def taken():
        """Take a picture with the key once nothing seems to change, and wait until it is whole."""
        until(lambda: at_rest(screen))
        file = tmp_path / f"torus-{next(numbers):04d}.png"
        hand.do("key", "p")
        until(file.exists)
        until(lambda: whole(file))
        return np.asarray(Image.open(file)).astype(int)

    def picture():
        """Take pictures until one is like the one before: on a busy machine frames take longer than a look."""
        before, now = taken(), taken()
        while not np.array_equal(before, now):
            before, now = now, taken()
        return now

    arguments = (model_file, "--size", "700x500", "--folder", tmp_path, "--frame-time", 0, "--json", "--seconds", 600)
    with viewing(screen, *arguments) as process:
        window = hand.window("torus")
        until(lambda: np.ptp(on_screen(screen)[200:300, 500:600]) > 100)  # the torus, right of the panel
        still = picture()
        assert still.shape[0] == 500  # beside the panel
        assert 350 < still.shape[1] < 420
        assert covered(still) > 0.1

        hand.do("key", "r")
        hand.drag((560, 250), (460, 290))
        time.sleep(0.3)
        hand.do("key", "r")
        until(lambda: list(tmp_path.glob("torus-path-*.json")))
        assert (picture() != still).any(axis=2).mean() > 0.05

        hand.do("mousemove", 500, 250)
        hand.do("click", "--repeat", 5, "--delay", 60, 4)
        assert covered(picture()) > 1.15 * covered(still)

        hand.do("key", "Home")
        np.testing.assert_allclose(picture(), still, atol=2)

        hand.do("key", "5")
        assert (picture() != still).any(axis=2).mean() > 0.05

        hand.do("windowsize", window, 600, 420)
        assert picture().shape == (420, 600, 3)  # so narrow that the panel stands on it

        hand.do("key", "Tab", "u")
        assert (picture() != on_screen(screen)[:420, :600]).any(axis=2).mean() < 0.1  # axes and scale

        hand.do("key", "ctrl+q")
        out, problems = process.communicate(timeout=30)
    assert (process.returncode, problems) == (0, "")
    report = json.loads(out)
    assert report["pictures"] >= 6
    assert report["splats"] > 1000
    path = ViewPath.read(next(tmp_path.glob("torus-path-*.json")))
    assert path.moves
    assert path.at(0.0) != path.at(path.times[-1])


def on_screen(display):
    """What the display shows, (h, w, 3) uint8; seen by a process of its own, whose Xlib is not that of our windows."""
    code = "import sys; from PIL import ImageGrab; ImageGrab.grab(xdisplay=sys.argv[1]).save(sys.stdout.buffer, 'PPM')"
    seen = subprocess.run([sys.executable, "-c", code, display], capture_output=True, check=True)
    return np.asarray(Image.open(io.BytesIO(seen.stdout)))


def at_rest(display):
    """Whether nothing beside the panel changes for a while: everything is loaded, and drawn as well as it gets."""
    before = on_screen(display)[:, 340:]
    time.sleep(0.7)
    return (before == on_screen(display)[:, 340:]).all()


def whole(file):
    try:
        Image.open(file).load()
    except OSError:
        return False
    return True


def covered(picture):
    return float((picture != picture[0, 0]).any(axis=2).mean())


def test_no_frame_waits_for_the_network(screen, model_file):
    """10 s over ADSL: every C function that the frame loop's thread calls is looked at, and none does I/O."""
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client", "tests"))
    done = subprocess.run(
        [sys.executable, "-m", "support.watched_session", str(model_file), "10"],
        env={**os.environ, "DISPLAY": screen, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["calls"] > 1000
    assert report["blocked"] == []
    assert report["bytes"] > 100_000
    assert report["splats"] > 1000
    assert report["requests"] > 3


def test_what_is_dropped_is_opened_or_explained(screen, model_file, tmp_path):
    """A file, a file: address, an address of a host, a scan, what is not there; on a window that began with nothing."""
    shutil.copy(model_file, tmp_path / "a model.lpc")
    path = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client", "tests"))
    with serve_in_thread(tmp_path) as url:
        targets = [
            str(model_file),
            f"file://{tmp_path}/a%20model.lpc\r\n",
            f"{url}/a%20model.lpc",
            "/scans/field.laz",
            str(tmp_path / "none.lpc"),
            "/scans/field.laz",
        ]
        done = subprocess.run(
            [sys.executable, "-m", "support.dropping", *targets],
            env={**os.environ, "DISPLAY": screen, "PYTHONPATH": path},
            capture_output=True, text=True, check=False, timeout=300,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, local, remote, scan, missing, again = json.loads(done.stdout)
    for found, name in ((first, model_file), (local, tmp_path / "a model.lpc"), (remote, f"{url}/a%20model.lpc")):
        assert found["title"] == f"{name} - pointstream"
        assert found["splats"] > 500
        assert found["message"] == ""
    assert "`pointstream build field.laz -o MODEL.lpc`" in scan["message"]
    assert scan["title"] == remote["title"], "a scan leaves the model on the screen"
    assert "there is no such file" in missing["message"]
    assert again["message"] == scan["message"], "what is told now comes before what failed"


def test_an_unreachable_model_is_a_message_not_a_wait(screen, tmp_path):
    noise = tmp_path / "noise.lpc"
    noise.write_bytes(bytes(range(256)) * 300)
    with viewing(screen, noise, "--seconds", 1.5, "--size", "300x200") as process:
        _, problem = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "noise.lpc" in problem


def test_without_a_display_it_says_so(model_file):
    with viewing("", model_file) as process:
        _, problem = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "no window can be opened here" in problem
    assert problem.count("\n") == 1


def test_a_missing_file_is_said_before_a_missing_display(tmp_path):
    with viewing("", tmp_path / "none.lpc") as process:
        _, problem = process.communicate(timeout=60)
    assert process.returncode == 1
    assert problem.endswith("none.lpc: there is no such file\n")
    assert problem.count("\n") == 1
