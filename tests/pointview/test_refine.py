"""Cuts against LPC's recursion, node by node, and against properties that every cut must have."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import models, placed

from pointview.camera import Camera
from pointview.refine import FEW, Cut, refine
from pointview.splats import CLOSING, LARGEST


@pytest.fixture(scope="module")
def ball():
    return models.sphere(12_000, cloud_size=128)


@pytest.fixture(scope="module")
def ring():
    return models.torus(12_000, cloud_size=128)


def camera_at(eye, *, width=300, height=200, fov_y=45.0, target=(0.1, 0.0, 0.05)):
    return Camera(eye=eye, target=target, up=(0, 0, 1), fov_y=fov_y, width=width, height=height)


def recursion(model, camera, tolerance, resident, known, cull_backfaces):
    """LPC 4 in its own words: {node: (starved, spacing shown)}, wants, pages."""
    index = model.index
    planes, eye = camera.frustum_planes(), np.array(camera.eye)
    drawn: dict[int, tuple[bool, float]] = {}
    wants: list[int] = []
    pages: set[int] = set()  # of the wants that are unknown
    culled = {"frustum": 0, "backface": 0}

    def visible(node):
        to = index.center[node] - eye
        radius, distance = index.radius[node], math.dist(index.center[node], eye)
        if any(float(plane @ to) < -radius for plane in planes):
            culled["frustum"] += 1
            return False
        if cull_backfaces and distance > radius and index.cone_angle[node] < math.pi / 2:
            spread = float(index.cone_angle[node]) + math.asin(radius / distance)
            if spread < math.pi / 2 and float(index.cone_axis[node] @ to) / distance > math.sin(spread):
                culled["backface"] += 1
                return False
        return True

    def pixels(node):
        gap = math.dist(index.center[node], eye) - index.radius[node]
        return math.inf if gap <= 0 else index.spacing[node] * camera.focal / gap

    def visit(node):
        own = index.spacing[node] * placed.share(index, node, camera)
        if pixels(node) < tolerance or (index.children[node] < 0).all():
            drawn[node] = (False, own)
            return own
        starved, shown = False, 0.0
        for child in index.children[node].tolist():
            if child < 0:
                continue
            if not known[child]:
                pages.add(child // index.header.page_nodes)
                wants.append(child)
                starved = True
            elif visible(child):
                if resident[child]:
                    shown = max(shown, visit(child))
                else:
                    wants.append(child)
                    starved = True
        drawn[node] = (starved, max(shown, own) if starved else shown)
        return drawn[node][1]

    if visible(0):
        if resident[0]:
            visit(0)
        else:
            wants.append(0)
    return drawn, sorted(wants), pages, culled


eyes = st.tuples(*[st.floats(-4, 4)] * 3).filter(lambda eye: math.dist(eye, (0.1, 0, 0.05)) > 0.05)


@settings(max_examples=60, deadline=None)
@given(
    eye=eyes,
    tolerance=st.floats(0.3, 40),
    seed=st.integers(0, 5),
    share=st.floats(0, 1),
    cull=st.booleans(),
    which=st.booleans(),
)
def test_agrees_with_the_recursion(ball, ring, eye, tolerance, seed, share, cull, which):
    model = ball if which else ring
    resident = np.random.default_rng(seed).random(model.header.nodes) < share
    camera = camera_at(eye)
    cut = refine(model.index, camera, tolerance, resident, cull_backfaces=cull)
    drawn, wants, pages, culled = recursion(model, camera, tolerance, resident, model.index.known, cull)
    assert cut.nodes.tolist() == sorted(drawn)
    assert cut.starved.tolist() == [drawn[node][0] for node in sorted(drawn)]
    np.testing.assert_allclose(cut.spacing, [drawn[node][1] for node in sorted(drawn)], rtol=1e-6)
    assert cut.wants.tolist() == wants
    assert set(cut.pages.tolist()) == pages
    assert (cut.culled.frustum, cut.culled.backface) == (culled["frustum"], culled["backface"])
    assert cut.culled.occluded == 0
    assert cut.splats == model.index.samples[cut.nodes].sum()


@settings(max_examples=30, deadline=None)
@given(eye=eyes, tolerance=st.floats(0.3, 40), seed=st.integers(0, 5))
def test_every_cut_is_closed_and_asks_only_for_what_is_missing(ring, eye, tolerance, seed):
    index = ring.index
    resident = np.random.default_rng(seed).random(ring.header.nodes) < 0.7
    resident[0] = True
    cut = refine(index, camera_at(eye), tolerance, resident)
    drawn = np.zeros(ring.header.nodes, dtype=bool)
    drawn[cut.nodes] = True
    assert resident[cut.nodes].all()
    assert not resident[cut.wants].any()
    others = cut.nodes[cut.nodes > 0]
    assert drawn[index.parent[others]].all()
    assert drawn[index.parent[cut.wants]].all()
    assert len(np.unique(cut.wants)) == len(cut.wants)
    assert (cut.splat_px >= 1).all()
    assert (cut.splat_px <= LARGEST).all()


@settings(max_examples=30, deadline=None)
@given(eye=eyes, tolerance=st.floats(0.3, 40), seed=st.integers(0, 5))
def test_what_is_asked_ahead_is_drawn_in_the_end(ring, eye, tolerance, seed):
    index, camera = ring.index, camera_at(eye)
    resident = np.random.default_rng(seed).random(ring.header.nodes) < 0.8
    resident[0] = True
    cut = refine(index, camera, tolerance, resident)
    assert cut.asks.tolist() == cut.wants.tolist() + cut.ahead.tolist()
    assert len(np.unique(cut.asks)) == len(cut.asks)
    assert not resident[cut.asks].any()
    whole = refine(index, camera, tolerance, np.ones_like(resident))
    assert set(cut.asks.tolist()) <= set(whole.nodes.tolist())
    if 0 < len(cut.wants) <= FEW:
        below = set(index.parent[cut.ahead].tolist())
        children = index.children[cut.wants]
        wanted = [n for n in np.intersect1d(children[children >= 0], whole.nodes).tolist() if not resident[n]]
        assert set(wanted) <= set(cut.ahead.tolist())
        assert bool(below) == bool(len(cut.ahead))


def test_no_node_that_shows_a_sample_is_culled(ball, ring):
    rng = np.random.default_rng(8)
    for model in (ball, ring):
        for eye in rng.uniform(-3, 3, (6, 3)):
            camera = camera_at(tuple(eye))
            cut = refine(model.index, camera, 1e-9, model.everything)
            drawn = np.zeros(model.header.nodes, dtype=bool)
            drawn[cut.nodes] = True
            for node in np.flatnonzero(~drawn).tolist():
                xyz = model.positions(node)
                pixel, depth = camera.project(xyz)
                inside = (depth > 0) & (pixel >= 0).all(axis=1) & (pixel < [300, 200]).all(axis=1)
                codes = model.clouds[node].codes["normal"].astype(float) / 127 - 1
                normal = np.stack([*codes.T, 1 - np.abs(codes).sum(axis=1)], axis=1)
                below = normal[:, 2] < 0
                normal[below, :2] = (1 - np.abs(codes[below][:, ::-1])) * np.where(codes[below] >= 0, 1, -1)
                faces = np.einsum("ij,ij->i", normal, xyz - eye) < 0
                assert not (inside & faces).any()


def test_projected_spacing_by_hand(ball):
    index = ball.index
    camera = camera_at((0, -5, 0), target=(0, 0, 0), height=400)
    cut = refine(index, camera, 1e9, ball.everything)
    assert cut.nodes.tolist() == [0]
    assert not cut.starved[0]
    gap = math.dist(index.center[0], camera.eye) - index.radius[0]
    expected = index.spacing[0] * 400 / (2 * math.tan(math.radians(22.5))) / gap
    assert cut.max_spacing_px == pytest.approx(expected)
    assert cut.splat_px[0] == pytest.approx(CLOSING * expected * placed.share(index, 0, camera))


def test_an_eye_inside_a_sphere_refines_it(ball):
    camera = camera_at((0, 0, 0.2), target=(1, 0, 0.2))
    cut = refine(ball.index, camera, 1e9, ball.everything, cull_backfaces=False)
    assert len(cut.nodes) > 1
    starving = refine(ball.index, camera, 1e9, ball.first(1), cull_backfaces=False)
    assert starving.nodes.tolist() == [0]
    assert starving.starved.all()
    assert starving.splat_px[0] == LARGEST
    assert starving.max_spacing_px == 300  # the larger side of the picture stands for "without bound"


def test_tolerance_is_met_where_everything_is_resident(ring):
    camera = camera_at((0, -4, 2), width=120, height=80)
    for tolerance in (1.0, 3.0, 10.0):
        cut = refine(ring.index, camera, tolerance, ring.everything)
        assert not cut.starved.any()
        assert len(cut.wants) == 0
        leaves = (ring.index.children[cut.nodes] < 0).all(axis=1)
        if not leaves.any():
            assert cut.max_spacing_px < tolerance


def test_a_starved_node_is_grown_and_its_refined_sibling_is_not(ring):
    camera = camera_at((0, -4, 2))
    full = refine(ring.index, camera, 0.5, ring.everything, cull_backfaces=False)
    missing = ring.everything
    missing[ring.index.children[1][0]] = False
    cut = refine(ring.index, camera, 0.5, missing, cull_backfaces=False)
    shown = dict(zip(cut.nodes.tolist(), cut.spacing.tolist(), strict=True))
    fine = dict(zip(full.nodes.tolist(), full.spacing.tolist(), strict=True))
    assert cut.nodes[cut.starved].tolist() == [1]
    assert shown[1] == pytest.approx(ring.index.spacing[1] * placed.share(ring.index, 1, camera), rel=1e-6)
    assert shown[0] == shown[1] > fine[0]  # the root's samples lie in the starved region too
    assert shown[2] == fine[2]


def test_before_anything_came(ring):
    camera = camera_at((0, -4, 2))
    nothing = np.zeros(ring.header.nodes, dtype=bool)
    cut = refine(ring.index, camera, 1.0, nothing)
    assert cut.nodes.tolist() == []
    assert cut.wants.tolist() == [0]
    away = camera_at((0, -4, 2), target=(0, -8, 4))
    assert refine(ring.index, away, 1.0, nothing).wants.tolist() == []
    assert refine(ring.index, away, 1.0, ring.everything).nodes.tolist() == []


class Unread:
    """An index of which only some pages have come."""

    def __init__(self, index, known):
        for name in (
            "header",
            "center",
            "radius",
            "spacing",
            "samples",
            "size",
            "cone_axis",
            "cone_angle",
            "children",
            "parent",
            "density",
        ):
            values = getattr(index, name)
            if isinstance(values, np.ndarray):
                values = values.copy()
                values[~known] = 0
            setattr(self, name, values)
        self.known = known


@pytest.mark.parametrize("priority", ["index", "error"])
def test_unknown_children_make_their_page_wanted(ring, priority):
    camera = camera_at((0, -4, 2))
    known = np.arange(ring.header.nodes) < ring.header.page_nodes
    cut = refine(Unread(ring.index, known), camera, 0.5, known, priority=priority, cull_backfaces=False)
    assert cut.pages.tolist() == sorted(cut.pages.tolist())
    assert cut.pages[0] == 1
    children = ring.index.children[cut.nodes]
    unread = (children >= 0) & ~known[children]
    assert sorted(cut.wants.tolist()) == sorted(children[unread].tolist())
    np.testing.assert_array_equal(cut.starved, unread.any(axis=1))
    nothing = np.zeros_like(known)
    first = refine(Unread(ring.index, nothing), camera, 0.5, nothing)
    assert (first.nodes.tolist(), first.wants.tolist(), first.pages.tolist()) == ([], [0], [0])


def test_priorities(ring):
    camera = camera_at((0, -1.6, 0.5))
    resident = ring.first(20)
    by_index = refine(ring.index, camera, 0.5, resident, priority="index")
    by_error = refine(ring.index, camera, 0.5, resident, priority="error")
    assert by_index.wants.tolist() == sorted(by_error.wants.tolist())
    assert by_index.wants.tolist() != by_error.wants.tolist()
    assert by_error.wants.tolist() == refine(ring.index, camera, 0.5, resident, priority="error").wants.tolist()


def test_a_cut_says_what_it_is():
    assert {"nodes", "spacing", "splat_px", "starved", "wants", "pages", "culled"} <= set(Cut.__dataclass_fields__)
