"""The estimate of a view against what a streaming run of it really receives."""

from __future__ import annotations

import json

import pytest
from oracles import surfaces
from oracles.build import build_bytes
from support.streaming import stream

from pointstream.command import run as command


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    data = build_bytes(surfaces.torus(100_000), cloud_size=1024, page_nodes=32, spacing=0.0125)
    path = tmp_path_factory.mktemp("models") / "torus.lpc"
    path.write_bytes(data)
    return path


def estimate(capsys, model, *arguments):
    capsys.readouterr()
    assert command(["estimate", str(model), "--json", "--size", "160x120", *map(str, arguments)]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("tolerance", [0.8, 3.0])
def test_bytes_splats_and_seconds_are_those_of_a_run(model_file, tmp_path, capsys, tolerance):
    expected = estimate(capsys, model_file, "--tolerance", tolerance, "--link", "adsl")
    report = stream(model_file, tmp_path / "run", "--tolerance", tolerance, "--seconds", 6)
    assert expected["splats"] == report["curve"][-1]["splats"]
    assert expected["bytes"] == pytest.approx(report["bytes"], rel=0.1)  # gaps weigh more than in a scan
    assert expected["seconds"] == pytest.approx(report["settled_s"], rel=0.05, abs=0.25)  # slow start
    assert expected["bytes_read"] < max(expected["bytes"], 66_000)


def test_a_view_that_sees_nothing_costs_the_first_request(model_file, tmp_path, capsys):
    view = tmp_path / "away.json"
    view.write_text(json.dumps({"eye": [0, -9, 0], "target": [0, -20, 0], "up": [0, 0, 1], "fov_y": 40}))
    found = estimate(capsys, model_file, "--view", view)
    assert (found["clouds"], found["splats"], found["cloud_bytes"]) == (0, 0, 0)
    assert found["bytes"] == min(65536, model_file.stat().st_size)


def test_it_says_what_it_does_not_know(model_file, capsys):
    assert "hidden" in estimate(capsys, model_file)["left_out"]["occlusion"]
    assert command(["estimate", str(model_file), "--link", "adsl"]) == 0
    assert "what is hidden" in capsys.readouterr().out


def test_a_finer_tolerance_costs_more(model_file, capsys):
    costs = [estimate(capsys, model_file, "--tolerance", t)["bytes"] for t in (8.0, 2.0, 0.5)]
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]


def test_without_a_link_there_is_no_time(model_file, capsys):
    assert estimate(capsys, model_file)["seconds"] is None
    assert command(["estimate", str(model_file)]) == 0
    assert "give --link" in capsys.readouterr().out


def test_a_file_cut_short_costs_what_is_left(model_file, tmp_path, capsys):
    short = tmp_path / "short.lpc"
    short.write_bytes(model_file.read_bytes()[:150_000])
    whole, left = estimate(capsys, model_file, "--tolerance", 0.5), estimate(capsys, short, "--tolerance", 0.5)
    assert 0 < left["clouds"] < whole["clouds"]
    assert left["bytes"] <= 150_000 + 20_000


def test_clouds_that_wait_for_others_when_it_is_done_are_let_go(model_file, capsys, caplog):
    """Opening fetches clouds that no estimate needs, and some are being decoded when it closes the model."""
    estimate(capsys, model_file, "--link", "adsl")
    assert not [record for record in caplog.records if record.name == "asyncio"]


def test_a_wrong_link_is_a_wrong_argument(model_file, capsys):
    assert command(["estimate", str(model_file), "--link", "fast"]) == 2
    assert "--link" in capsys.readouterr().err
