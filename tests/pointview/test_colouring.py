"""Colours by attribute: the header and the clouds that a renderer gets, and what the legend says of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import surfaces
from support import models

from lpc.attributes import Attribute
from lpc.points import PointBatch
from pointview.camera import Camera
from pointview.colouring import CLASSES, MODES, Colouring, available_modes, class_name, class_table, ramp
from pointview.refine import refine
from pointview.render.backend import Style
from pointview.render.cpu import CpuBackend


@pytest.fixture(scope="module")
def scan():
    """A sphere whose intensity is its x, and whose classes are ground below and building above."""
    points = surfaces.sphere(6000, color=True)
    x, z = points.xyz[:, 0], points.xyz[:, 2]
    extra = {
        "intensity": np.rint((x + 1) * 30_000).astype(np.uint16),
        "classification": np.where(z < 0, 2, 6).astype(np.uint8),
    }
    return models.build(PointBatch(points.xyz, {**points.attributes, **extra}), 0.05, cloud_size=256)


def colouring(model, mode):
    return Colouring(mode, model.header, model.index, model.clouds[0])


def test_every_mode_that_the_attributes_allow(scan):
    assert available_modes(scan.header) == MODES
    bare = models.sphere(500, normals=False)
    assert available_modes(bare.header) == ("shading", "height", "level")


@pytest.mark.parametrize("mode", MODES)
def test_a_renderer_draws_it(scan, mode):
    colours = colouring(scan, mode)
    camera = Camera(eye=(0, -4, 0), target=(0, 0, 0), up=(0, 0, 1), width=90, height=80)
    cut = refine(scan.index, camera, 1.0, scan.everything)
    backend = CpuBackend(colours.header)
    frame = backend.draw(cut, lambda node: colours.cloud(node, scan.clouds[node]), camera, Style())
    backend.close()
    seen = frame.rgb[frame.node >= 0].astype(int)
    grey = np.ptp(seen, axis=1).max() < 40
    assert grey == (mode == "shading")
    assert (frame.node >= 0).any()


def test_the_models_own_colours_pass_untouched(scan):
    colours = colouring(scan, "color")
    assert colours.header is scan.header
    assert colours.cloud(3, scan.clouds[3]) is scan.clouds[3]
    assert colours.legend is None


def test_intensity_is_a_ramp_between_the_tails_of_the_root(scan):
    colours = colouring(scan, "intensity")
    legend = colours.legend
    assert 0 <= legend.low < 6000
    assert 54_000 < legend.high <= 60_000
    cloud = scan.clouds[5]
    values = cloud.codes["intensity"].astype(float)
    expected = ramp()[np.rint(np.clip((values - legend.low) / (legend.high - legend.low), 0, 1) * 255).astype(int)]
    attribute = next(each for each in scan.header.attributes if each.name == "intensity")
    if (attribute.scale, attribute.offset) == (1, 0):
        np.testing.assert_array_equal(colours.colors(5, cloud), expected)
    assert len(np.unique(colours.colors(5, cloud), axis=0)) > 3


def test_height_spans_the_bounds_along_the_vertical(scan):
    colours = colouring(scan, "height")
    y = scan.positions(0)[:, 1]
    place = (y - scan.header.bounds[1]) / (scan.header.bounds[4] - scan.header.bounds[1])
    np.testing.assert_allclose(colours.colors(0, scan.clouds[0]), ramp()[np.rint(place * 255).astype(int)], atol=2)
    assert (colours.legend.low, colours.legend.high) == (scan.header.bounds[1], scan.header.bounds[4])


def test_classes_have_their_names_and_colours(scan):
    colours = colouring(scan, "classification")
    assert colours.legend.entries == (("2 ground", CLASSES[2][1]), ("6 building", CLASSES[6][1]))
    shown = np.unique(np.concatenate([colours.colors(n, c) for n, c in enumerate(scan.clouds)]), axis=0)
    assert {tuple(color) for color in shown.tolist()} == {CLASSES[2][1], CLASSES[6][1]}
    assert len(class_table()) == 256


def test_the_legend_names_the_classes_that_were_coloured(scan):
    """The root is a sample: what is rare may come later."""
    colours = Colouring("classification", scan.header, scan.index, None)
    assert colours.legend.entries == ()
    rare = np.full(len(scan.clouds[1]), 65, dtype=np.uint8)
    attribute = next(each for each in scan.header.attributes if each.name == "classification")
    cloud = replace(scan.clouds[1], codes={**scan.clouds[1].codes, "classification": rare})
    colours.colors(1, cloud)
    code = int(attribute.decode(rare)[0])
    assert [text for text, _ in colours.legend.entries] == [f"{code} {class_name(code)}"]
    for node, each in enumerate(scan.clouds):
        colours.colors(node, each)
    assert len(colours.legend.entries) == 3
    assert (class_name(2), class_name(40), class_name(65)) == ("ground", "reserved", "user defined")


def test_height_follows_the_axis_that_is_up(scan):
    colours = Colouring("height", scan.header, scan.index, scan.clouds[0], up=2)
    assert "z" in colours.legend.title
    assert (colours.legend.low, colours.legend.high) == (scan.header.bounds[2], scan.header.bounds[5])


def test_the_legend_has_every_level_once(scan):
    entries = colouring(scan, "level").legend.entries
    levels = sorted(int(level) for text, _ in entries for level in text.split(", "))
    assert levels == list(range(scan.header.levels))


def test_levels_differ_from_their_neighbours(scan):
    colours = colouring(scan, "level")
    root, child = colours.colors(0, scan.clouds[0]), colours.colors(1, scan.clouds[1])
    assert (root == root[0]).all()
    assert (child == child[0]).all()
    assert (root[0] != child[0]).any()


def test_normals_are_directions(scan):
    colors = colouring(scan, "normal").colors(0, scan.clouds[0]).astype(float)
    directions = scan.positions(0) / np.linalg.norm(scan.positions(0), axis=1, keepdims=True)
    np.testing.assert_allclose((colors - 128) / 127, directions, atol=0.03)


def test_a_model_of_one_value_gets_the_middle_of_the_ramp():
    flat = PointBatch(np.random.default_rng(1).random((400, 3)) * (1, 0, 1), {})
    model = models.build(flat, 0.05, cloud_size=128)
    colors = colouring(model, "height").colors(0, model.clouds[0])
    assert (colors == colors[0]).all()


def test_the_added_attribute_is_an_ordinary_one(scan):
    added = colouring(scan, "height").header.attributes[-1]
    assert added == Attribute(name="color", kind="color", dtype="|u1", bits=8)
