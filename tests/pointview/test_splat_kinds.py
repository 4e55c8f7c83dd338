"""The kinds of splats are offered wherever one is chosen."""

from __future__ import annotations

from typing import get_args

import pytest

from pointview.cli import render
from pointview.render import Splat


def test_render_takes_every_kind():
    (option,) = (option for option in render.params if option.name == "splat")
    assert set(option.type.choices) == set(get_args(Splat))


def test_the_panel_offers_every_kind():
    pytest.importorskip("imgui_bundle")
    from pointview.window import panel

    assert set(panel.SPLATS) == set(get_args(Splat))
    assert all(panel.SPLAT_NAMES[kind] for kind in panel.SPLATS)
