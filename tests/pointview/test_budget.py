"""Budgets are kept from below within one cloud, by the clouds that come first."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import models

from pointview.budget import allowance, refine_within
from pointview.camera import Camera
from pointview.refine import refine


@pytest.fixture(scope="module")
def ring():
    return models.torus(12_000, cloud_size=64)


def camera_at(eye):
    return Camera(eye=eye, target=(0, 0, 0.1), up=(0, 0, 1), width=1500, height=1000)


eyes = st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda eye: math.hypot(*eye) > 0.2)


def within(model, camera, budget, *, at_least=0.5, here=None, **options):
    here = model.everything if here is None else here
    allowed = allowance(model.index, camera, budget, here, at_least=at_least, **options)
    return refine_within(model.index, camera, allowed, here, **options)


@given(eye=eyes, budget=st.integers(64, 15_000), cull=st.booleans(), seed=st.integers(0, 3))
def test_lands_from_below_within_a_cloud(ring, eye, budget, cull, seed):
    camera = camera_at(eye)
    here = np.random.default_rng(seed).random(ring.header.nodes) < (1.1 if seed == 0 else 0.8)
    here[0] = True
    cut = within(ring, camera, budget, here=here, cull_backfaces=cull)
    whole = refine(ring.index, camera, 0.5, here, cull_backfaces=cull)
    assert cut.splats <= max(budget, int(ring.index.samples[0]))
    if whole.splats > budget:
        assert cut.splats > budget - ring.header.cloud_size
    else:
        assert cut.nodes.tolist() == whole.nodes.tolist()
    assert set(cut.nodes.tolist()) <= set(whole.nodes.tolist())
    assert np.isin(ring.index.parent[cut.nodes[1:]], cut.nodes).all()


@given(eye=eyes, budget=st.integers(64, 12_000))
def test_what_the_budget_leaves_out_is_neither_wanted_nor_called_missing(ring, eye, budget):
    cut = within(ring, camera_at(eye), budget)
    assert not cut.starved.any()
    assert len(cut.wants) == 0


@given(eye=eyes, budget=st.integers(500, 12_000))
def test_nothing_coarser_waits_for_something_finer(ring, eye, budget):
    """A cloud is in before all whose limit is smaller: the oracle walks up to the root for each."""
    camera = camera_at(eye)
    cut, whole = within(ring, camera, budget), refine(ring.index, camera, 0.5, ring.everything)

    def limit(node):
        least = math.inf
        while node > 0:
            node = int(ring.index.parent[node])
            gap = math.dist(ring.index.center[node], camera.eye) - ring.index.radius[node]
            least = min(least, ring.index.spacing[node] * camera.focal / gap if gap > 0 else math.inf)
        return least

    drawn = set(cut.nodes.tolist())
    left = [limit(node) for node in whole.nodes.tolist() if node not in drawn]
    if left:
        assert min(limit(node) for node in drawn) >= max(left) * (1 - 1e-9)


def test_missing_clouds_stay_wanted(ring):
    camera, here = camera_at((0, -4, 1)), ring.first(40)
    allowed = allowance(ring.index, camera, 8000, ring.everything, at_least=0.5)
    cut = refine_within(ring.index, camera, allowed, here)
    goal = refine_within(ring.index, camera, allowed, ring.everything)
    assert len(cut.wants)
    assert set(cut.wants.tolist()) <= set(goal.nodes.tolist())
    assert cut.starved.any()


def test_a_budget_that_is_not_needed_changes_nothing(ring):
    cut = within(ring, camera_at((0, -4, 1)), 10**9, at_least=0.7)
    assert cut.nodes.tolist() == refine(ring.index, camera_at((0, -4, 1)), 0.7, ring.everything).nodes.tolist()


def test_a_budget_below_the_root_leaves_the_root(ring):
    assert within(ring, camera_at((0, -4, 1)), 3).nodes.tolist() == [0]


def test_nothing_to_draw(ring):
    nothing = np.zeros(ring.header.nodes, dtype=bool)
    assert within(ring, camera_at((0, -4, 1)), 10, here=nothing).splats == 0


def test_more_budget_draws_more_and_never_another_cut(ring):
    camera = camera_at((1, -3, 1))
    cuts = [set(within(ring, camera, budget).nodes.tolist()) for budget in (500, 2000, 5000, 10_000, 12_000)]
    for less, more in itertools.pairwise(cuts):
        assert less <= more


def test_a_real_scan_keeps_its_budgets(scan_path, tmp_path):
    """The dragon from twenty sides: within 2% or one cloud from below, whichever is more."""
    import pointstream
    from pointbuild.build import BuildOptions, build_model

    path = tmp_path / "dragon.lpc"
    build_model([scan_path("stanford_dragon.ply")], path, BuildOptions(), clock=lambda: 0.0)
    rng = np.random.default_rng(0)
    with pointstream.open(str(path)) as model:
        list(model.batches(level=99))  # reads the whole index
        index, header = model.index, model.header
        everything = index.known.copy()
        assert everything.all()
        low, high = np.array(header.bounds).reshape(2, 3)
        for _ in range(20):
            away = rng.normal(size=3)
            eye = (low + high) / 2 + away / np.linalg.norm(away) * np.linalg.norm(high - low) * rng.uniform(0.1, 1.5)
            camera = Camera(eye=tuple(eye), target=tuple((low + high) / 2), up=(0, 0, 1))
            whole = refine(index, camera, 0.01, everything).splats
            for share in (0.03, 0.1, 0.5, 0.9):
                budget = int(whole * share)
                allowed = allowance(index, camera, budget, everything, at_least=0.01)
                splats = refine_within(index, camera, allowed, everything).splats
                assert splats <= max(budget, header.cloud_size)
                assert splats >= budget - max(0.02 * budget, header.cloud_size)
