"""Densities of cells from the index, against counting samples one cell after another."""

from __future__ import annotations

import time

import numpy as np
import pytest
from support import shells

from lpc.density import EVEN
from lpc.header import parse_header
from lpc.index import IndexTree
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan


def read(data, order):
    index = IndexTree(parse_header(data))
    for page in order:
        index.add_page(page, data[int(index.page_offset[page]) :])
    return index


def build(sampling, folder, samples=30_000):
    path = folder / f"{sampling}.lpc"
    points = shells.sample(shells.TORUS, sampling, samples, normals=False)
    build_model([ArrayScan(points)], path, BuildOptions(threads=1, cloud_size=128), clock=time.monotonic)
    return path.read_bytes()


@pytest.fixture(scope="module")
def fading(tmp_path_factory):
    return build("fading", tmp_path_factory.mktemp("model"))


def slow(index, node=0, inside=None):
    """{node: (samples in its cell, area, mean square of the scan's own spacing)} of a subtree, by LPC equation 1."""
    inside = float(index.subtree[0]) if inside is None else inside
    drawn = inside - index.subtree[node] + index.samples[node]
    children = [child for child in index.children[node].tolist() if child >= 0]
    area = index.spacing[node] ** 2 * drawn
    if not children:
        return {node: (inside, area, area / inside)}
    rest = index.subtree[node] - index.samples[node]
    found = {}
    for child in children:
        found |= slow(index, child, inside * index.subtree[child] / rest)
    _, areas, squares = np.array([found[child] for child in children]).T
    return found | {node: (inside, area, (areas * squares).sum() / areas.sum())}


def test_shares_and_coarseness_by_recursion(fading):
    index = read(fading, range(parse_header(fading).pages))
    density = index.density
    inside, area, square = np.array([values for _, values in sorted(slow(index).items())]).T
    np.testing.assert_allclose(density.drawn, 1 - (index.subtree - index.samples) / inside, rtol=1e-9)
    np.testing.assert_allclose(density.full, np.sqrt(area / inside), rtol=1e-9)
    np.testing.assert_allclose(density.area, area, rtol=1e-9)
    np.testing.assert_allclose(density.contrast, np.sqrt(square) / density.full, rtol=1e-9)
    leaf = (index.children < 0).all(axis=1)
    np.testing.assert_allclose(density.full[leaf], index.spacing[leaf])
    uneven = np.sqrt(square) > EVEN * density.full
    np.testing.assert_array_equal(density.uneven, uneven & ~leaf)
    assert uneven.sum() > 10
    assert not uneven.all()
    shown = np.maximum(np.sqrt(square / density.drawn), index.spacing)
    np.testing.assert_allclose(density.coarseness, np.where(uneven, shown, index.spacing), rtol=1e-9)
    assert (density.coarseness / index.spacing).max() > 1.5


def test_pages_may_come_in_any_order(fading):
    header = parse_header(fading)
    assert header.pages > 0
    whole = read(fading, range(header.pages)).density
    rng = np.random.default_rng(0)
    for _ in range(3):
        index = IndexTree(header)
        while not index.page_loaded.all():
            page = int(rng.choice(np.flatnonzero(~index.page_loaded & (index.page_offset > 0))))
            index.add_page(page, fading[int(index.page_offset[page]) :])
        for name in ("full", "drawn", "coarseness", "uneven", "area", "contrast"):
            np.testing.assert_allclose(getattr(index.density, name), getattr(whole, name), rtol=1e-12)


def test_an_even_scan_keeps_its_spacings(tmp_path):
    data = build("random", tmp_path, 20_000)
    index = read(data, range(parse_header(data).pages))
    assert index.density.uneven.mean() < 0.02
    even = ~index.density.uneven
    np.testing.assert_array_equal(index.density.coarseness[even], index.spacing[even])
