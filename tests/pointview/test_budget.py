"""Budgets are kept from below, and no smaller tolerance would keep them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import models

from pointview.budget import tolerance_for_budget
from pointview.camera import Camera
from pointview.refine import refine


@pytest.fixture(scope="module")
def ring():
    return models.torus(12_000, cloud_size=64)


def camera_at(eye):
    return Camera(eye=eye, target=(0, 0, 0.1), up=(0, 0, 1), width=1500, height=1000)


eyes = st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda eye: math.hypot(*eye) > 0.2)


@given(eye=eyes, budget=st.integers(64, 15_000), cull=st.booleans(), seed=st.integers(0, 3))
def test_lands_from_below_at_the_smallest_tolerance_that_does(ring, eye, budget, cull, seed):
    camera = camera_at(eye)
    resident = np.random.default_rng(seed).random(ring.header.nodes) < (1.1 if seed == 0 else 0.8)
    resident[0] = True

    def splats(tolerance):
        return refine(ring.index, camera, tolerance, resident, cull_backfaces=cull).splats

    tolerance = tolerance_for_budget(ring.index, camera, budget, resident, at_least=0.5, cull_backfaces=cull)
    assert splats(tolerance) <= budget or tolerance == math.inf
    if tolerance > 0.5:
        finer = 1e9 if tolerance == math.inf else tolerance * (1 - 1e-12)
        assert splats(finer) > budget


def test_a_budget_that_is_not_needed_changes_nothing(ring):
    assert tolerance_for_budget(ring.index, camera_at((0, -4, 1)), 10**9, ring.everything, at_least=0.7) == 0.7


def test_a_budget_below_the_root_leaves_the_root(ring):
    camera = camera_at((0, -4, 1))
    tolerance = tolerance_for_budget(ring.index, camera, 3, ring.everything, at_least=1.0)
    assert tolerance == math.inf
    assert refine(ring.index, camera, tolerance, ring.everything).nodes.tolist() == [0]


def test_nothing_to_draw(ring):
    nothing = np.zeros(ring.header.nodes, dtype=bool)
    assert tolerance_for_budget(ring.index, camera_at((0, -4, 1)), 10, nothing, at_least=1.0) == 1.0


def test_tolerance_grows_as_the_budget_shrinks(ring):
    camera = camera_at((1, -3, 1))
    found = [
        tolerance_for_budget(ring.index, camera, budget, ring.everything, at_least=0.1)
        for budget in (12_000, 10_000, 5000, 2000, 500)
    ]
    assert found == sorted(found)
    assert np.isfinite(found).all()
