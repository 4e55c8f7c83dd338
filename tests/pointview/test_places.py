"""Where a splat grows: at the places where data is missing, and nowhere else."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import models, placed, shells

from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointbuild.cells import Cells
from pointview import splats
from pointview.camera import Camera
from pointview.places import halvings
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend


@pytest.fixture(scope="module")
def ring():
    return models.torus(12_000, cloud_size=128)


CAMERA = Camera(eye=(0.5, -2.0, 3.0), target=(0, 0, 0), up=(0, 0, 1), width=240, height=200)


class Bounds:
    def __init__(self, low, high):
        self.bounds = (*low, *high)


@given(
    low=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    sides=st.tuples(*[st.one_of(st.just(0.0), st.just(1.0), st.floats(1e-3, 1e4))] * 3),
)
def test_cells_are_those_of_the_build(low, sides):
    high = tuple(a + b for a, b in zip(low, sides, strict=True))
    cells = Cells.over(np.array(low), np.array(high))
    levels = cells.depths + 2
    axes, halves = halvings(Bounds(low, high), levels)
    assert axes[: cells.depths].tolist() == cells.axes.tolist()
    assert (halves[: cells.depths] > 0).all()
    assert not halves[cells.depths :].any()
    for axis in range(3):
        along = halves[: cells.depths][cells.axes == axis]
        np.testing.assert_array_equal(along, cells.extent[axis] * 0.5 ** np.arange(1, len(along) + 1))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 50), share=st.floats(0.2, 1), tolerance=st.floats(0.5, 20))
def test_corners_and_links_lead_down_the_tree(ring, seed, share, tolerance):
    resident = np.random.default_rng(seed).random(ring.header.nodes) < share
    resident[0] = True
    cut = refine(ring.index, CAMERA, tolerance, resident)
    row_of = {node: row for row, node in enumerate(cut.nodes.tolist())}
    for row, node in enumerate(cut.nodes.tolist()):
        box, axis = placed.cell_of(ring.header, placed.path_of(ring.index, node))
        np.testing.assert_allclose(cut.places.corner[row], box[0], atol=1e-9)
        level = ring.index.level[node]
        assert cut.places.axis[level] == axis
        assert cut.places.half[level] == pytest.approx((box[1] - box[0])[axis] / 2)
        children = ring.index.children[node].tolist()
        assert cut.places.link[row].tolist() == [row_of.get(child, -1) for child in children]
        missing = np.isin(children, cut.wants)
        np.testing.assert_array_equal(cut.places.spacing[row] < 0, missing)
        assert (np.abs(cut.places.spacing[row]) <= cut.spacing[row] * (1 + 1e-6)).all()


def test_only_the_starved_half_grows(ring):
    missing = ring.everything
    missing[ring.index.children[0][0]] = False
    axis = int(np.argmax(np.subtract(ring.header.bounds[3:], ring.header.bounds[:3])))
    middle = (ring.header.bounds[axis] + ring.header.bounds[axis + 3]) / 2
    cut = refine(ring.index, CAMERA, 0.5, missing, cull_backfaces=False)
    full = refine(ring.index, CAMERA, 0.5, ring.everything, cull_backfaces=False)
    style, backend = Style(two_sided=True, close_holes=False), CpuBackend(ring.header)
    frame = backend.draw(cut, ring.take, CAMERA, style)
    whole = backend.draw(full, ring.take, CAMERA, style)
    row, column = np.nonzero(np.isfinite(frame.depth))
    depth = frame.depth[row, column].astype(float)
    right, up = (column + 0.5 - CAMERA.width / 2) / CAMERA.focal, (CAMERA.height / 2 - row - 0.5) / CAMERA.focal
    at = np.array(CAMERA.eye) + (np.stack([right, up, np.ones(len(row))], axis=1) * depth[:, None]) @ CAMERA.rotation()
    reach = splats.CLOSING * ring.index.spacing[0]
    inside, beside = at[:, axis] < middle - reach, at[:, axis] > middle + reach
    assert inside.sum() > 1000
    assert beside.sum() > 1000
    assert frame.starved[row, column][inside].all()
    assert not frame.starved[row, column][beside].any()
    # Beside the hole the picture is the finished one.
    same = (frame.rgb == whole.rgb).all(axis=2)[row, column]
    assert same[beside].all()
    assert same[inside].mean() < 0.5
    assert refine(ring.index, CAMERA, 0.5, missing, splat_rule="paper").places is None


def test_the_rule_of_the_paper(ring):
    cut = refine(ring.index, CAMERA, 2.0, ring.first(9), splat_rule="paper")
    own = ring.index.spacing[cut.nodes]
    gap = np.linalg.norm(ring.index.center[cut.nodes] - CAMERA.eye, axis=1) - ring.index.radius[cut.nodes]
    assert cut.starved.any()
    np.testing.assert_allclose(cut.spacing[cut.starved], own[cut.starved], rtol=1e-6)
    refined = ~cut.starved & (gap > 0) & (own * CAMERA.focal / gap > 2.0)
    assert refined.any()
    np.testing.assert_allclose((cut.spacing * CAMERA.focal / gap)[refined], 2.0, rtol=1e-5)


@pytest.fixture(scope="module")
def fading(tmp_path_factory):
    """A torus whose one end is a hundred times denser than the other, as the build writes it."""
    path = tmp_path_factory.mktemp("model") / "fading.lpc"
    points = shells.sample(shells.TORUS, "fading", 30_000, normals=False)
    build_model([ArrayScan(points)], path, BuildOptions(threads=1, cloud_size=128), clock=time.monotonic)
    return models.load(path.read_bytes())


@pytest.mark.parametrize("nodes", [1, 6, 40])
def test_thin_parts_of_a_cell_grow_where_nothing_of_them_is_here(fading, nodes):
    """At every sample the table says what walking down the tree says."""
    index, density = fading.index, fading.index.density
    cut = refine(index, CAMERA, 0.5, fading.first(nodes), cull_backfaces=False)
    places, rows = cut.places, {node: row for row, node in enumerate(cut.nodes.tolist())}
    assert len(places.link) > len(cut.nodes)
    ratios = []
    for sample in np.concatenate([fading.positions(node) for node in cut.nodes.tolist()])[::7]:
        node, path = 0, []
        while True:  # to the deepest drawn node
            box, axis = placed.cell_of(fading.header, path)
            half = int(sample[axis] >= box[:, axis].mean())
            child = int(index.children[node][half])
            if child not in rows:
                break
            node, path = child, [*path, half]
        spacing, drawn, cell = index.spacing[node] * placed.share(index, node, CAMERA), node, node
        while density.uneven[cell] and (child := int(index.children[cell][half])) >= 0:
            cell, path = child, [*path, half]
            spacing = density.full[cell] / np.sqrt(density.drawn[drawn])
            box, axis = placed.cell_of(fading.header, path)
            half = int(sample[axis] >= box[:, axis].mean())
        ratios.append(spacing / found(places, rows[drawn], index.level[drawn], sample))
    # Cells whose samples are less than a pixel apart are not looked into.
    assert np.median(ratios) == pytest.approx(1.0, rel=1e-5)
    assert np.mean(np.isclose(ratios, 1.0, rtol=1e-4)) > 0.95


def found(places, row, level, sample):
    """Spacing of a table of places at a sample of a drawn node."""
    at = sample - places.corner[row]
    while row >= 0:
        axis = places.axis[level]
        half = int(at[axis] >= places.half[level])
        at[axis] -= half * places.half[level]
        row, spacing, level = places.link[row][half], places.spacing[row][half], level + 1
    return abs(spacing)
