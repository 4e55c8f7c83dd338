"""Hosts that are not ours: what `doctor` says of them, and a whole model read from them."""

from __future__ import annotations

import asyncio
import json
import os
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from click.testing import CliRunner
from support.servers import REPOSITORY, serve_in_thread
from support.webhosts import HOSTS, installed, web_host

from lpc.errors import RangesUnsupported
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointstream.doctor_cli import doctor
from pointstream.layer import AccessLayer
from pointstream.remedies import RECIPES
from pointstream.stores.http import HttpStore
from pointstream.stores.replies import SMALL_FILE

if TYPE_CHECKING:
    from pathlib import Path

SAMPLES = 40_000
GOOD_HOSTS = [name for name in HOSTS if name not in ("http.server", "lighttpd")]


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model of several pages, and one that is small enough to be taken whole."""
    folder = tmp_path_factory.mktemp("models")
    chance = np.random.default_rng(7)
    for name, count in (("large", SAMPLES), ("small", 500)):
        color = chance.integers(0, 255, (count, 3), dtype=np.uint8)
        noise = chance.integers(0, 1 << 32, count, dtype=np.uint32)
        points = PointBatch(chance.normal(size=(count, 3)), {"color": color, "noise": noise})
        out = folder / f"{name}.lpc"
        build_model([ArrayScan(points)], out, BuildOptions(attributes=("all",), threads=1), clock=time.monotonic)
        os.utime(out, (1e9, 1e9))  # a file that changed within this second has a weak tag at Apache
    return folder


def examine(address: str, *arguments: str) -> tuple[int, dict[str, Any]]:
    result = CliRunner().invoke(doctor, [address, "--json", *arguments], catch_exceptions=False)
    return result.exit_code, json.loads(result.output)


def levels(report: dict[str, Any]) -> dict[str, str]:
    return {finding["topic"]: finding["level"] for finding in report["findings"]}


def read_all(address: str) -> tuple[int, int]:
    """Open a model, want everything, and count the samples of all clouds and the nodes that were drawn from."""

    async def run() -> tuple[int, int]:
        store = HttpStore(address, clock=asyncio.get_running_loop().time)
        layer = await AccessLayer.open(store)
        try:
            everything = np.arange(layer.header.nodes)
            async with asyncio.timeout(20):
                while not layer.resident.all():
                    layer.end_frame(everything, pinned=[])
                    await asyncio.sleep(0.002)
            assert not layer.stats.errors
            return sum(len(layer.take(node)) for node in everything.tolist()), layer.header.nodes
        finally:
            await layer.close()

    return asyncio.run(run())


def need(name: str) -> None:
    if not installed(name):
        pytest.skip(f"{name} is not installed")


@pytest.mark.parametrize("name", GOOD_HOSTS)
def test_with_its_recipe_a_host_has_no_fault(name: str, models: Path, tmp_path: Path) -> None:
    need(name)
    with web_host(name, models, tmp_path / name) as url:
        status, report = examine(f"{url}/large.lpc", "--rest", "0.2")
        assert read_all(f"{url}/large.lpc")[0] == SAMPLES
    assert status == 0
    assert report["can_serve"]
    assert report["complete"]
    found = levels(report)
    assert {topic: level for topic, level in found.items() if level not in ("good", "unknown")} == {}, report
    assert report["goodput_bits_per_second"] > 0
    assert report["recipes"] == {}


@pytest.mark.parametrize("name", [*GOOD_HOSTS, "lighttpd"])
def test_as_it_comes_a_host_serves_and_is_told_what_is_missing(name: str, models: Path, tmp_path: Path) -> None:
    need(name)
    with web_host(name, models, tmp_path / name, recipe=False) as url:
        status, report = examine(f"{url}/large.lpc", "--rest", "0")
        assert read_all(f"{url}/large.lpc")[0] == SAMPLES
    found = levels(report)
    assert (status, found["ranges"], found["model"], found["browsers"]) == (0, "good", "good", "advice")
    assert found["idle limit"] == ("advice" if name == "apache2" else "unknown"), "Apache says 5 s"
    assert found["compression"] == ("advice" if name == "apache2" else "good"), "the test's Apache compresses"
    assert report["recipes"]


def test_ours_is_the_best_host(models: Path) -> None:
    with serve_in_thread(models, cors=("*",)) as url:
        status, report = examine(f"{url}/large.lpc", "--rest", "0.2")
        assert read_all(f"{url}/large.lpc")[0] == SAMPLES
    assert status == 0
    assert set(levels(report).values()) == {"good"}


def test_python_http_server_cannot(models: Path, tmp_path: Path) -> None:
    assert (models / "small.lpc").stat().st_size < SMALL_FILE < (models / "large.lpc").stat().st_size / 5
    with web_host("http.server", models, tmp_path / "python") as url:
        status, report = examine(f"{url}/large.lpc")
        assert (status, report["can_serve"], levels(report)["ranges"]) == (1, False, "failure")
        assert set(report["recipes"]) == set(RECIPES)
        text = CliRunner().invoke(doctor, [f"{url}/large.lpc"])
        assert "cannot serve models" in text.output
        with pytest.raises(RangesUnsupported):
            read_all(f"{url}/large.lpc")
        assert read_all(f"{url}/small.lpc")[0] == 500, "a file this small is taken whole"


def test_recipes_are_those_of_the_documentation() -> None:
    page = (REPOSITORY / "docs" / "hosting.md").read_text()
    for name, lines in RECIPES.items():
        indented = "\n".join(f"    {line}" if line else "" for line in lines.strip().splitlines())
        assert indented in page, f"docs/hosting.md has other lines for {name}"
