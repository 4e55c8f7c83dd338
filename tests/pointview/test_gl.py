"""OpenGL against the CPU backend: the same picture but for at most 0.1% of the covered pixels.

Both project and cover in float32, so a pixel centre on the rim of a splat may fall either way; everything else is
equal to 2 of 255 levels. Which of two samples at equal depth is seen may differ as well, in 2% of the pixels.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from support import models, shells

from lpc.errors import Unavailable
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, open_backend
from pointview.render.cpu import CpuBackend

moderngl = pytest.importorskip("moderngl")
LEVELS = 2
SHARE = 0.001
TIES = 0.02
RESOLUTION = 2.5e-7
"""Of a depth buffer of 24 bits as these views use it, relative."""


@pytest.fixture(scope="module", autouse=True)
def gl():
    from pointview.render.gl import GlBackend

    try:
        GlBackend(models.sphere(50).header).close()
    except Unavailable as error:
        pytest.skip(str(error))
    return GlBackend


SCENES = ["normals", "normals and colours", "colours", "nothing", "survey coordinates", "uneven"]


@pytest.fixture(scope="module", params=SCENES)
def scene(request, tmp_path_factory):
    eye, target = np.array([1.0, -2.5, 2.0]), np.zeros(3)
    if request.param == "survey coordinates":
        target = np.array([512_345.0, 6_012_345.0, 123.0])
        model = models.sphere(8000, at=tuple(target), color=True)
    elif request.param == "uneven":
        path = tmp_path_factory.mktemp("model") / "uneven.lpc"
        points = shells.sample(shells.TORUS, "fading", 8000, normals=False)
        build_model([ArrayScan(points)], path, BuildOptions(threads=1, cloud_size=128), clock=time.monotonic)
        model = models.load(path.read_bytes())
    else:
        model = models.torus(8000, normals="normals" in request.param, color="colours" in request.param)
    camera = Camera(eye=tuple(target + eye), target=tuple(target), up=(0, 0, 1), width=161, height=120)
    return model, camera


def assert_same(frame, oracle, share=SHARE, *, ties=False):
    covered = np.isfinite(frame.depth) | np.isfinite(oracle.depth)
    assert covered.sum() > 200
    assert (np.isfinite(frame.depth) != np.isfinite(oracle.depth)).sum() <= share * covered.sum()
    difference = np.abs(frame.rgb.astype(int) - oracle.rgb).max(axis=2)
    differs = covered & (difference > LEVELS)
    if ties:
        both = np.where(np.isfinite(frame.depth), frame.depth, 0), np.where(np.isfinite(oracle.depth), oracle.depth, 0)
        tied = differs & np.isclose(*both, rtol=RESOLUTION, atol=0)
        assert tied.sum() <= TIES * covered.sum()
        differs &= ~tied
    assert differs.sum() <= share * covered.sum()
    assert difference[~covered].max(initial=0) == 0
    assert (frame.node != oracle.node)[covered].mean() <= TIES
    both = np.isfinite(frame.depth) & np.isfinite(oracle.depth)
    expected = oracle.depth[both]
    assert (np.abs(frame.depth[both] - expected) > 1e-5 * expected).mean() <= share
    assert (frame.starved != oracle.starved)[covered].mean() <= TIES
    assert (frame.splats, frame.clouds) == (oracle.splats, oracle.clouds)


@pytest.mark.parametrize("indirect", [True, False])
@pytest.mark.parametrize("two_sided", [True, False])
def test_the_cpu_picture(gl, scene, indirect, two_sided):
    model, camera = scene
    style = Style(two_sided=two_sided, background=(30, 60, 90))
    backend, oracle = gl(model.header, indirect=indirect), CpuBackend(model.header)
    for tolerance, resident in (
        (1.0, model.everything),
        (6.0, model.everything),
        (1.0, model.first(1)),
        (1.0, model.first(7)),
    ):
        cut = refine(model.index, camera, tolerance, resident, cull_backfaces=not two_sided)
        assert_same(backend.draw(cut, model.take, camera, style), oracle.draw(cut, model.take, camera, style))
    backend.close()


@pytest.mark.parametrize("splat", ["square", "round"])
def test_other_splats(gl, scene, splat):
    model, camera = scene
    style, backend, oracle = Style(splat=splat), gl(model.header), CpuBackend(model.header)
    for tolerance in (1.0, 6.0):
        cut = refine(model.index, camera, tolerance, model.everything)
        # They have nearly one depth: where many overlap, some tie in the 24 bits of a depth buffer.
        expected, frame = oracle.draw(cut, model.take, camera, style), backend.draw(cut, model.take, camera, style)
        assert_same(frame, expected, ties=True)
    backend.close()


@pytest.mark.parametrize("indirect", [True, False])
def test_blended_pictures(gl, scene, indirect):
    model, camera = scene
    backend, oracle = gl(model.header, indirect=indirect), CpuBackend(model.header)
    for tolerance, resident, two_sided in (
        (1.0, model.everything, False),
        (6.0, model.everything, True),
        (1.0, model.first(7), False),
    ):
        style = Style(splat="blended", two_sided=two_sided, background=(30, 60, 90))
        cut = refine(model.index, camera, tolerance, resident, cull_backfaces=not two_sided)
        frame, expected = (one.draw(cut, model.take, camera, style) for one in (backend, oracle))
        # Another sample that is seen lies at another depth, and lets others count around it.
        assert_same(frame, expected, 3 * SHARE)
    backend.close()


def test_inside_the_model(gl):
    model = models.torus(8000)
    camera = Camera(eye=(1.0, 0.02, 0.03), target=(1.0, 1.0, 0.2), up=(0, 0, 1), width=120, height=90)
    style = Style(two_sided=True)
    cut = refine(model.index, camera, 2.0, model.everything, cull_backfaces=False)
    backend = gl(model.header)
    assert_same(
        backend.draw(cut, model.take, camera, style), CpuBackend(model.header).draw(cut, model.take, camera, style)
    )
    backend.close()


def test_a_small_arena_gives_the_same_picture_in_several_passes(gl):
    model = models.torus(8000)
    camera = Camera(eye=(1, -2.5, 2), target=(0, 0, 0), up=(0, 0, 1), width=161, height=120)
    cut = refine(model.index, camera, 1.0, model.everything)
    small = gl(model.header, arena_bytes=10 * 256 * 12)
    large = gl(model.header)
    expected = large.draw(cut, model.take, camera, Style())
    assert len(cut.nodes) > 30
    for _ in range(2):
        frame = small.draw(cut, model.take, camera, Style())
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.node, expected.node)
    blended = [backend.draw(cut, model.take, camera, Style(splat="blended")).rgb for backend in (small, large)]
    assert (blended[0] != expected.rgb).any()
    np.testing.assert_array_equal(*blended)
    small.close()
    large.close()


class Narrow:
    """A context that allows textures of so many texels a side."""

    def __init__(self, context, most):
        self._context, self.info = context, {**context.info, "GL_MAX_TEXTURE_SIZE": most}

    def __getattr__(self, name):
        return getattr(self._context, name)

    def __enter__(self):
        return self._context.__enter__()

    def __exit__(self, *error):
        return self._context.__exit__(*error)


@pytest.mark.parametrize("most", [600, 100])
def test_clouds_in_small_textures_give_the_same_picture(gl, monkeypatch, most):
    from pointview.render import gl as module

    model, make = models.torus(8000), module._context
    camera = Camera(eye=(1, -2.5, 2), target=(0, 0, 0), up=(0, 0, 1), width=161, height=120)
    cut = refine(model.index, camera, 1.0, model.everything)
    large = gl(model.header)
    monkeypatch.setattr(module, "_context", lambda: Narrow(make(), most))
    narrow = gl(model.header, indirect=False)
    expected = large.draw(cut, model.take, camera, Style())
    assert (narrow._arena.slots < len(cut.nodes)) == (most == 100)  # 100: a cloud takes three rows
    for _ in range(2):
        frame = narrow.draw(cut, model.take, camera, Style())
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.node, expected.node)
    narrow.close()
    large.close()


def test_clouds_stay_in_gpu_memory_and_sizes_may_change(gl):
    model = models.torus(4000)
    backend = gl(model.header)
    for size in ((100, 80), (100, 80), (64, 90)):
        camera = Camera(eye=(1, -2.5, 2), target=(0, 0, 0), up=(0, 0, 1), width=size[0], height=size[1])
        cut = refine(model.index, camera, 3.0, model.everything)
        model.taken.clear()
        frame = backend.draw(cut, model.take, camera, Style())
        assert frame.rgb.shape == (size[1], size[0], 3)
        assert frame.uploads == len(model.taken)
    assert backend.draw(cut, model.take, camera, Style()).uploads == 0
    backend.close()


def test_an_empty_cut(gl):
    model = models.torus(300)
    camera = Camera(eye=(0, -4, 0), target=(0, -8, 0), up=(0, 0, 1), width=20, height=10)
    cut = refine(model.index, camera, 1.0, model.everything)
    backend = gl(model.header)
    frame = backend.draw(cut, model.take, camera, Style(background=(1, 2, 3)))
    assert (frame.rgb == [1, 2, 3]).all()
    assert np.isinf(frame.depth).all()
    backend.close()


def test_software_opengl_is_left_to_the_cpu(gl):
    header = models.torus(300).header
    backend = gl(header)
    software = "llvmpipe" in backend.renderer
    backend.close()
    if software:
        assert open_backend("auto", header).name == "cpu"
        asked = open_backend("gl", header)
        assert asked.name.startswith("gl")
        asked.close()


def test_without_opengl_the_cpu_draws(monkeypatch):
    def refuse(**_):
        raise RuntimeError("no display\nand no EGL")

    monkeypatch.setattr(moderngl, "create_context", refuse)
    header = models.torus(300).header
    assert open_backend("auto", header).name == "cpu"
    with pytest.raises(Unavailable, match="no display and no EGL"):
        open_backend("gl", header)
