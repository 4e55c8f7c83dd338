"""Where splats may be smaller than what closes a sheet by splats alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import models, placed

from pointview.camera import Camera
from pointview.refine import refine
from pointview.snug import FINE, SNUG, snug

CAMERA = Camera(eye=(0.5, -2.0, 3.0), target=(0, 0, 0), up=(0, 0, 1), width=240, height=200)


@pytest.fixture(scope="module")
def ring():
    return models.torus(12_000, cloud_size=128)


def test_cells_that_hold_a_whole_body_keep_their_size_and_sheets_do_not(ring):
    index, nodes = ring.index, np.arange(ring.header.nodes)
    shares = snug(index, nodes, np.full(len(nodes), math.inf))
    assert shares[0] == 1.0
    deep = shares[index.level > 4]
    assert np.median(deep) == pytest.approx(SNUG)
    assert ((shares >= SNUG) & (shares <= 1.0)).all()


def test_splats_of_about_a_pixel_keep_their_size(ring):
    nodes = np.arange(ring.header.nodes)
    for spacing_px in (0.0, 0.3, FINE):
        assert (snug(ring.index, nodes, np.full(len(nodes), spacing_px)) == 1.0).all()
    sizes = [snug(ring.index, nodes, np.full(len(nodes), px)) * px for px in np.linspace(0.1, 10, 100)]
    assert (np.diff(sizes, axis=0) >= 0).all()  # what is further apart never gets a smaller splat


def test_shares_one_by_one(ring):
    nodes = np.arange(ring.header.nodes)
    gap = np.linalg.norm(ring.index.center - CAMERA.eye, axis=1) - ring.index.radius
    shares = snug(ring.index, nodes, ring.index.density.coarseness * CAMERA.focal / gap)
    np.testing.assert_allclose(shares, [placed.share(ring.index, node, CAMERA) for node in nodes.tolist()], rtol=1e-9)


def test_the_rule_of_the_paper_knows_no_shares(ring):
    cut = refine(ring.index, CAMERA, 1.0, ring.first(12), splat_rule="paper")
    np.testing.assert_allclose(cut.spacing[cut.starved], ring.index.spacing[cut.nodes][cut.starved], rtol=1e-6)
