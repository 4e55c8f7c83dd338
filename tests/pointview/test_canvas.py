"""What a frame gives away stays as it is while anyone holds a part of it, and is memory for other frames after."""

from __future__ import annotations

import numpy as np
from support import models

from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.canvas import Canvas
from pointview.render.cpu import CpuBackend


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_given_again_when_no_view_of_it_is_left():
    canvas = Canvas(4, 6, 1, 30)
    first = canvas.empty(np.float32)
    assert (first.shape, first.dtype) == ((4, 6), np.float32)
    at = address(first)
    part = first[1:, ::2].T
    del first
    other = canvas.empty(np.float32)
    assert address(other) != at
    del part
    again = canvas.empty(np.uint8, 4)  # as many bytes
    assert (again.shape, address(again)) == ((4, 6, 4), at)


def test_frames_that_are_kept_keep_their_pictures():
    model = models.torus(2000)
    backend, kept = CpuBackend(model.header, threads=2), []
    for turn in range(4):
        camera = Camera(eye=(1 - turn, -2.5, 2), target=(0, 0, 0), up=(0, 0, 1), width=60, height=40)
        cut = refine(model.index, camera, 1.0, model.everything)
        frame = backend.draw(cut, model.take, camera, Style())
        kept.append((frame, [np.copy(part) for part in (frame.rgb, frame.depth, frame.node, frame.starved)]))
    for frame, copies in kept:
        for part, copy in zip((frame.rgb, frame.depth, frame.node, frame.starved), copies, strict=True):
            np.testing.assert_array_equal(part, copy)
    backend.close()
