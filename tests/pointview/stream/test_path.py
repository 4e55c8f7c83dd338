"""Camera paths: interpolation between views, and files that are none."""

from __future__ import annotations

import json

import pytest

from lpc.errors import FormatError
from pointview.stream.path import ViewPath

START = {"eye": [0.0, 0.0, 5.0], "target": [0.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0], "fov_y": 40.0}
END = {"eye": [4.0, 0.0, 1.0], "target": [0.0, 2.0, 0.0], "up": [0.0, 1.0, 0.0], "fov_y": 60.0}


def write(tmp_path, value):
    path = tmp_path / "path.json"
    path.write_text(value if isinstance(value, str) else json.dumps(value))
    return path


def test_values_between_two_times_and_outside(tmp_path):
    path = ViewPath.read(write(tmp_path, [{"t": 1, **START}, {"t": 3, **END}]))
    assert path.moves
    assert path.at(0.0) == path.at(1.0) == START
    assert path.at(3.0) == path.at(99.0) == END
    middle = path.at(1.5)
    assert middle == {"eye": [1.0, 0.0, 4.0], "target": [0.0, 0.5, 0.0], "up": [0.0, 1.0, 0.0], "fov_y": 45.0}


def test_three_views_each_reached_in_its_time(tmp_path):
    path = ViewPath.read(write(tmp_path, [{"t": 0, **START}, {"t": 1, **END}, {"t": 2, **START}]))
    assert [path.at(t)["fov_y"] for t in (0.0, 0.5, 1.0, 1.75, 2.0)] == [40.0, 50.0, 60.0, 45.0, 40.0]


def test_one_view_does_not_move(tmp_path):
    path = ViewPath.read(write(tmp_path, [{"t": 7, **START}]))
    assert not path.moves
    assert path.at(0.0) == ViewPath.still(START).at(12.0) == START


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("[", "is not JSON"),
        ("{}", "a list of at least one view"),
        ("[]", "a list of at least one view"),
        ('"text"', "a list of at least one view"),
        ([START], "entry 0: needs a time"),
        ([{"t": 0, **START}, {"t": "soon", **END}], "entry 1: needs a time"),
        ([{"t": 0, **START}, {"t": 0, **END}], "must increase"),
        ([{"t": 2, **START}, {"t": 1, **END}], "must increase"),
        ('[{"t": NaN, "eye": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0]}]', "must increase"),
        ([{"t": 0, "eye": [0, 0]}], "entry 0: view: eye must be three numbers"),
        ([{"t": 0, **START, "target": START["eye"]}], "same point"),
        ([3], "entry 0"),
    ],
)
def test_what_is_no_path(tmp_path, content, why):
    with pytest.raises(FormatError, match=why) as caught:
        ViewPath.read(write(tmp_path, content))
    assert "\n" not in str(caught.value)
    assert "path.json" in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(FormatError, match=r"absent\.json: cannot be read"):
        ViewPath.read(tmp_path / "absent.json")
