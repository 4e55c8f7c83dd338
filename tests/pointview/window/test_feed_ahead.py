"""The feed looks ahead of a camera that moves, and of no other."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from oracles import surfaces
from oracles.build import build_bytes

from pointlink.profiles import parse_profile
from pointview.camera import Camera
from pointview.refine import refine
from pointview.window.feed import Feed, View
from pointview.window.mirror import Mirror

FRAME = 1 / 60
TOLERANCE = 5.0
DEADLINE = 60.0


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    points = surfaces.torus(40_000)
    points.attributes["color"] = np.random.default_rng(1).integers(0, 65536, (len(points), 3), dtype=np.uint16)
    path = tmp_path_factory.mktemp("ahead") / "torus.lpc"
    path.write_bytes(build_bytes(points, cloud_size=256, page_nodes=64, spacing=0.02))
    return path


def orbit(angle: float) -> Camera:
    eye = (2.2 * math.cos(angle), 2.2 * math.sin(angle), 0.4)
    return Camera(eye=eye, target=(math.cos(angle), math.sin(angle), 0.0), up=(0, 0, 1), width=320, height=240)


class Viewer:
    """The frame loop of a viewer, without pictures."""

    def __init__(self, feed):
        self.feed, self.mirror = feed, Mirror()
        self.until = time.monotonic() + DEADLINE

    def frame(self, camera):
        """One frame; True if it lacks nothing."""
        assert time.monotonic() < self.until
        time.sleep(FRAME)
        self.mirror.take_in(self.feed.news())
        if self.mirror.index is None:
            return False
        cut = refine(self.mirror.index, camera, TOLERANCE, self.mirror.resident)
        view = View(camera=camera, tolerance=TOLERANCE, cull_backfaces=True, hidden=None)
        self.feed.ask(self.mirror.build, cut.asks, cut.nodes, view)
        return len(cut.nodes) > 0 and len(cut.wants) == 0


def test_a_camera_that_moves_finds_what_it_comes_to_and_one_at_rest_asks_for_nothing(model):
    feed = Feed(str(model), link=parse_profile("4M,40ms"))
    try:
        viewer, angle = Viewer(feed), 0.0
        while not viewer.frame(orbit(angle)):
            pass
        for _ in range(30):
            viewer.frame(orbit(angle))
        assert feed.stats.speculative_bytes == 0
        while feed.stats.speculative_bytes - feed.stats.wasted_bytes < 10_000:
            angle += 0.2 * FRAME
            viewer.frame(orbit(angle))
        while viewer.feed.stats.in_flight or not viewer.frame(orbit(angle)):  # at rest again
            viewer.frame(orbit(angle))
        at_rest = feed.stats.requests
        for _ in range(60):
            viewer.frame(orbit(angle))
        assert feed.stats.requests == at_rest
    finally:
        feed.close()
