"""What a frame costs outside compiled code: Python does as much for many clouds as for few, and memory stays fixed."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace

import numpy as np
import pytest
from support import models

from lpc.errors import Unavailable
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend

CAMERA = Camera(eye=(0.3, -3, 1), target=(0, 0, 0), up=(0, 0, 1), width=64, height=48)
STYLE = Style(two_sided=True, splat="square", close_holes=False)


@pytest.fixture(scope="module")
def model():
    return models.sphere(6000, cloud_size=16)


@pytest.fixture(params=["cpu", "gl", "gl 3.3"])
def backend(request, model):
    if request.param == "cpu":
        opened = CpuBackend(model.header)
    else:
        gl = pytest.importorskip("pointview.render.gl")
        try:
            opened = gl.GlBackend(model.header, indirect=request.param == "gl")
        except Unavailable as error:
            pytest.skip(str(error))
        if request.param == "gl" and not opened._indirect:
            opened.close()
            pytest.skip("no OpenGL 4.3")
    yield opened
    opened.close()


def cut_of(model, nodes):
    """The first nodes of the whole cut, drawn by the plain rule."""
    whole = refine(model.index, CAMERA, 1e-3, model.everything, cull_backfaces=False)
    assert len(whole.nodes) > 300
    some = {name: getattr(whole, name)[:nodes] for name in ("nodes", "spacing", "splat_px", "starved")}
    return replace(whole, places=None, **some)


def calls(work):
    """Calls of Python and of C functions of some work, a garbage collection's callbacks and finalizers apart."""
    count = 0

    def seen(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    gc.collect()
    gc.disable()
    sys.setprofile(seen)
    try:
        work()
    finally:
        sys.setprofile(None)
        gc.enable()
    return count


def test_a_frame_makes_as_many_calls_for_many_clouds_as_for_few(backend, model):
    few, many = cut_of(model, 20), cut_of(model, 300)
    for cut in (many, few, many):
        backend.draw(cut, model.take, CAMERA, STYLE)
    counted = [calls(lambda cut=cut: backend.draw(cut, model.take, CAMERA, STYLE)) for cut in (few, many)]
    assert counted[1] == counted[0] > 0


def test_frames_keep_nothing_of_their_clouds(backend, model):
    cut = cut_of(model, 300)
    for _ in range(3):
        backend.draw(cut, model.take, CAMERA, STYLE)
    gc.collect()
    before = sys.getallocatedblocks()
    for _ in range(20):
        backend.draw(cut, model.take, CAMERA, STYLE)
    gc.collect()
    assert sys.getallocatedblocks() - before < len(cut.nodes)  # not one object a cloud, let alone one a frame


def test_an_arena_keeps_its_size_and_the_cut_in_it(model):
    gl = pytest.importorskip("pointview.render.gl")
    try:
        backend = gl.GlBackend(model.header, arena_bytes=200 * 16 * 12)
    except Unavailable as error:
        pytest.skip(str(error))
    try:
        size = backend._memory.size
        whole = refine(model.index, CAMERA, 1e-3, model.everything, cull_backfaces=False).nodes
        rng = np.random.default_rng(0)
        for _ in range(30):
            some = np.sort(rng.choice(whole, 150, replace=False))
            chosen = replace(cut_of(model, 150), nodes=some)
            frame = backend.draw(chosen, model.take, CAMERA, STYLE)
            assert (backend._arena.slots_of(some) >= 0).all()  # nothing of the cut gave way to another of it
            again = backend.draw(chosen, model.take, CAMERA, STYLE)
            assert (frame.uploads <= 150, again.uploads) == (True, 0)
        assert (backend._memory.size) == size
        assert len(backend._arena.count) == 200
    finally:
        backend.close()
