"""A session without a window: what is hidden is neither drawn nor asked for, and a camera at rest comes to rest."""

from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from oracles import surfaces
from support import models
from support.display import until

from lpc.points import PointBatch
from pointbuild.readers.detect import SUFFIXES
from pointview.camera import Camera
from pointview.occlusion import KEPT, Occlusion
from pointview.refine import refine
from pointview.render import open_backend
from pointview.window.commands import SCANS, tidied
from pointview.window.culling import STRIDE
from pointview.window.inputs import Inputs
from pointview.window.mirror import Came, Failed, Opened
from pointview.window.painter import Painter
from pointview.window.settings import Settings
from pointview.window.viewer import Viewer, ViewerOptions

SIZE = (160, 160)
VIEW = {"eye": [0.4, -2.5, 1.0], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 45.0}


@pytest.fixture(scope="module")
def onion():
    """Five spheres in one another: from outside only the largest is seen."""
    shells = [surfaces.sphere(6000, seed=number, radius=1 - 0.15 * number) for number in range(5)]
    points = PointBatch(
        np.concatenate([shell.xyz for shell in shells]),
        {"normal": np.concatenate([shell.normal for shell in shells])},
    )
    return models.build(points, 0.035, cloud_size=128)


class Feed:
    """What comes from a model: some clouds a frame of what was wanted last."""

    stats, longest_handover, target = None, 0.0, "onion.lpc"

    def __init__(self, model, each):
        self.model, self.each = model, each
        self.queue = [Opened(model.index, 1)]
        self.wants, self.given, self.closed = [], set(), False

    @property
    def wanting(self):
        return bool(self.queue or set(self.wants) - self.given)

    def news(self):
        taken, self.queue = self.queue, []
        for node in [node for node in self.wants if node not in self.given][: self.each]:
            self.given.add(node)
            taken.append(Came(node, self.model.clouds[node]))
        return taken

    def ask(self, build, wants, pinned, view):
        self.wants = wants.tolist()

    def close(self):
        self.closed = True


class Session:
    """A viewer with a clock of its own, 30 frames a second."""

    def __init__(self, model, *, each=1000, **settings):
        self.now = 0.0
        self.feed = Feed(model, each)
        options = ViewerOptions(backend="cpu", view=VIEW)
        chosen = Settings(**{"tolerance": 3.0, "steady": False, "two_sided": True, **settings})
        self.viewer = Viewer(lambda _: self.feed, options, chosen, clock=lambda: self.now)
        self.viewer.open("onion.lpc")

    def frame(self, **did):
        self.now += 1 / 30
        return self.viewer.advance(replace(Inputs(seconds=1 / 30, size=SIZE), **did))

    def rest(self, most=200):
        """Frames until there is nothing to do any more."""
        until(lambda: (self.frame(), self.viewer.painter.ready)[1])
        for number in range(most):
            self.frame()
            if not self.viewer.busy and not self.feed.wanting:
                return number
        raise AssertionError(f"busy after {most} frames")


@pytest.fixture
def session(onion):
    sessions = []

    def make(**settings):
        sessions.append(Session(onion, **settings))
        return sessions[-1]

    yield make
    for each in sessions:
        each.viewer.close()


def whole(model, session):
    """The picture with everything drawn."""
    camera = session.viewer.view.camera
    cut = refine(model.index, camera, 3.0, model.everything, cull_backfaces=False)
    backend = open_backend("cpu", model.header)
    try:
        return cut, backend.draw(cut, model.take, camera, session.viewer.settings.style())
    finally:
        backend.close()


def differing(frame, other):
    covered = (frame.node >= 0) | (other.node >= 0)
    return (frame.rgb != other.rgb).any(axis=2)[covered].mean()


def test_a_still_camera_leaves_out_what_is_hidden_and_comes_to_rest(session, onion):
    one = session(each=6)
    one.rest()
    viewer = one.viewer
    cut, expected = whole(onion, one)
    assert viewer.cut.culled.occluded > 0
    assert viewer.cut.splats < 0.5 * cut.splats
    assert differing(viewer.frame, expected) < 0.002
    assert viewer.culling.verdict is None
    assert not viewer.cut.starved.any()
    for _ in range(20):  # at rest nothing is drawn
        assert one.frame() is None
    assert viewer.loaded[0] == viewer.loaded[1] > 0


def test_what_is_hidden_is_not_fetched(session, onion):
    fetched = {}
    for occlusion in (True, False):
        one = session(occlusion=occlusion, each=6)
        one.rest()
        fetched[occlusion] = sum(int(onion.index.size[node]) for node in one.feed.given)
        assert not set(one.viewer.cut.wants.tolist())
    assert fetched[True] < 0.9 * fetched[False], fetched


def test_a_moving_camera_shows_in_the_frame_what_was_hidden(session, onion):
    """Around the model and into it: no frame lacks what the whole picture has."""
    one = session(tolerance=3.0)
    one.rest()
    for node in range(onion.header.nodes):  # so that nothing waits for data
        one.feed.queue.append(Came(node, onion.clouds[node]))
    one.rest()
    worst = 0.0
    for step in range(30):
        flown = {"held": frozenset("w")} if step > 15 else {"turned": (14.0, 0.0)}
        one.frame(**flown)
        _, expected = whole(onion, one)
        worst = max(worst, differing(one.viewer.frame, expected))
    assert worst < 0.005


@pytest.mark.parametrize(("cost", "asked"), [(0.001, 12), (0.018, 6), (0.5, 4)])
def test_tests_keep_to_their_share_of_moving_frames(session, monkeypatch, cost, asked):
    one = session()
    one.rest()
    looks, look, draw = [], Occlusion.look, Painter.draw

    def slow_look(*arguments, **options):
        looks.append(options["stride"])
        one.now += cost
        return look(*arguments, **options) and 0  # no third pass

    def slow_draw(*arguments):
        one.now += 0.1
        return draw(*arguments)

    monkeypatch.setattr(Occlusion, "look", slow_look)
    monkeypatch.setattr(Painter, "draw", slow_draw)
    one.frame(turned=(2.0, 0.0))
    looks.clear()
    for _ in range(12):
        one.frame(turned=(2.0, 0.0))
    assert looks == [STRIDE] * asked
    one.rest()
    assert looks[-1] == 1


def test_the_budget_counts_what_is_seen(session, onion):
    one = session(limited=True, budget=11_600, tolerance=1.0)
    one.rest()
    assert one.viewer.cut.culled.occluded > 0
    assert 11_600 - 2 * onion.header.cloud_size <= one.viewer.cut.splats <= 11_600


def test_culling_is_switched_off_and_on(session):
    one = session()
    one.rest()
    fewer = one.viewer.cut.splats
    one.viewer.settings.occlusion = False
    one.rest()
    assert one.viewer.cut.culled.occluded == 0
    assert one.viewer.cut.splats > fewer
    one.viewer.settings.occlusion = True
    one.rest()
    assert one.viewer.cut.splats == pytest.approx(fewer, rel=0.05)


def test_where_nothing_is_hidden_it_stops_and_says_so():
    model = models.sphere(6000, cloud_size=64)
    one = Session(model, each=1000, two_sided=False, tolerance=2.0)
    try:
        one.rest()
        for _ in range(2 * KEPT + 4):  # the trial is over once the camera has moved a little
            one.frame(turned=(5.0, 0.0))
        assert "paused" in one.viewer.culling.verdict
        one.rest()
        assert one.viewer.cut.culled.occluded == 0
        for _ in range(20):
            one.frame()
        assert one.viewer.loaded[0] == one.viewer.loaded[1]
    finally:
        one.viewer.close()


def test_a_model_that_fails_is_a_message_and_the_next_one_is_shown(session, onion):
    one = session()
    one.feed.queue = [Failed("onion.lpc: no such file")]
    one.frame()
    assert one.viewer.message == "onion.lpc: no such file"
    failed, one.feed = one.feed, Feed(onion, 1000)
    one.frame(dropped=("other.lpc",))
    assert failed.closed
    one.rest()
    assert one.viewer.message == ""
    assert one.viewer.frame.splats > 0


def test_what_keeps_data_from_coming_is_said_each_time_and_then_forgotten(session):
    one = session()
    one.rest()
    for count, now in ((1, 100.0), (2, 200.0)):
        one.feed.stats = SimpleNamespace(errors=(SimpleNamespace(text="host: down", count=count),))
        one.now = now
        one.frame()
        assert one.viewer.message == "host: down"
        one.now = now + 50.0
        one.frame()
        assert one.viewer.message == ""


def test_the_first_view_is_the_asked_one(session):
    one = session()
    one.rest()
    assert one.viewer.view.camera == Camera.from_view(VIEW, width=160, height=160)


def test_the_window_lives_while_the_renderer_gets_ready(session, monkeypatch):
    """After an installation kernels compile for seconds: frames go on, and so does what they ask for."""
    compiled = threading.Event()
    work = Painter._try
    monkeypatch.setattr(Painter, "_try", lambda *arguments: (compiled.wait(30), work(*arguments))[1])
    one = session(each=1)
    for _ in range(5):
        assert one.frame() is None
    assert len(one.feed.given) == 4  # all but the frame that opened
    assert not one.viewer.busy
    compiled.set()
    one.rest()
    assert one.viewer.frame.splats > 0


@pytest.mark.parametrize(
    ("given", "target"),
    [
        ("/data/a b.lpc", "/data/a b.lpc"),
        (" 'C:\\scans\\a.lpc'\n", "C:\\scans\\a.lpc"),
        ('"/data/a.lpc"', "/data/a.lpc"),
        ("file:///data/a%20b.lpc\r\nfile:///data/c.lpc", "/data/a b.lpc"),
        ("file://localhost/data/a.lpc", "/data/a.lpc"),
        ("https://host/a%20b.lpc?token=x", "https://host/a%20b.lpc?token=x"),
        ("", ""),
    ],
)
def test_what_was_dropped_or_pasted(given, target):
    assert tidied(given) == target


def test_all_that_build_reads_is_known_to_be_a_scan():
    assert set(SCANS) == SUFFIXES
