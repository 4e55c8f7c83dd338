"""Models for people: what `read` gives is exactly what was asked for."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import shells
from support.frames import decoded_clouds, whole_index
from support.servers import serve_in_thread

import pointstream
from lpc.codec import cloud_to_points
from lpc.errors import Corrupt, ModelChanged, NotFound, StoreError
from lpc.header import parse_header
from lpc.index import IndexTree
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan

if TYPE_CHECKING:
    from pathlib import Path

    from pointstream.model import Model


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, model: bytes) -> Path:
    file = tmp_path_factory.mktemp("models") / "model.lpc"
    file.write_bytes(model)
    return file


@pytest.fixture(scope="module")
def opened(path: Path) -> Model:
    with pointstream.open(str(path)) as model:
        yield model  # type: ignore[misc]


@pytest.fixture(scope="module")
def clouds(model: bytes) -> tuple[IndexTree, list[PointBatch]]:
    """All clouds, read in the most obvious way."""
    header = parse_header(model)
    return whole_index(model), [cloud_to_points(cloud, header) for cloud in decoded_clouds(model)]


def same(a: PointBatch, b: PointBatch) -> None:
    assert (a.xyz == b.xyz).all()
    assert a.attributes.keys() == b.attributes.keys()
    for name, values in a.attributes.items():
        assert (values == b.attributes[name]).all()
        assert values.dtype == b.attributes[name].dtype


def test_everything(opened: Model, clouds: tuple[IndexTree, list[PointBatch]], scan: PointBatch) -> None:
    points = opened.read()
    same(points, PointBatch.concatenate(clouds[1]))
    assert len(points) == len(scan)
    assert opened.index.known.all()


@pytest.mark.parametrize("level", [0, 1, 3, 99])
def test_levels(opened: Model, clouds: tuple[IndexTree, list[PointBatch]], level: int) -> None:
    index, parts = clouds
    same(opened.read(level=level), PointBatch.concatenate(parts[n] for n in np.flatnonzero(index.level <= level)))


@pytest.mark.parametrize("spacing", [1e-9, 0.5, 1.0, 100.0])
def test_spacing_refines_what_is_too_coarse(
    opened: Model, clouds: tuple[IndexTree, list[PointBatch]], spacing: float
) -> None:
    index, parts = clouds
    wanted = [0]
    for node in range(1, len(index)):
        above = int(index.parent[node])
        if above in wanted and index.spacing[above] > spacing:
            wanted.append(node)
    same(opened.read(spacing=spacing), PointBatch.concatenate(parts[n] for n in wanted))


def test_spacing_is_that_of_the_sparse_half_too(tmp_path: Path) -> None:
    """As refinement for the screen has it: an uneven cell is as coarse as the root of its mean square over the area."""
    points = shells.sample(shells.TORUS, "halves", 30_000, normals=False)
    options = BuildOptions(threads=1, cloud_size=128)
    build_model([ArrayScan(points)], tmp_path / "halves.lpc", options, clock=time.monotonic)
    with pointstream.open(str(tmp_path / "halves.lpc")) as model:
        spacing = 8 * model.header.spacing
        count = model.count(spacing=spacing)
        assert len(model.read(spacing=spacing)) == count, "what was counted is what is read"
        index = model.index
        deeper = index.known & (index.density.coarseness > spacing)
        assert (index.spacing[deeper] <= spacing).any(), "there is a cell that only unevenness makes too coarse"
        read = {0} | set(index.children[deeper].ravel().tolist()) - {-1}
        assert count == index.samples[sorted(read)].sum()


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-12, 12), min_size=6, max_size=6))
def test_bounds_are_exact(opened: Model, clouds: tuple[IndexTree, list[PointBatch]], corners: list[float]) -> None:
    center = np.array([500_000.0, 4_000_000.0, 120.0])
    low, high = np.minimum(corners[:3], corners[3:]) + center, np.maximum(corners[:3], corners[3:]) + center
    everything = PointBatch.concatenate(clouds[1])
    inside = ((everything.xyz >= low) & (everything.xyz <= high)).all(axis=1)
    same(opened.read(bounds=[*low, *high]), everything.take(inside))


def test_nothing_there_still_has_the_attributes(opened: Model, scan: PointBatch) -> None:
    points = opened.read(bounds=[0, 0, 0, 1, 1, 1])
    assert len(points) == 0
    assert points.attributes.keys() == scan.attributes.keys()


def test_nonsense_is_refused(opened: Model) -> None:
    for bad in ({"bounds": [1, 2]}, {"bounds": [1, 0, 0, 0, 0, 0]}, {"spacing": 0.0}, {"level": -1}):
        with pytest.raises(ValueError, match=r"bounds|spacing|level"):
            opened.read(**bad)  # type: ignore[arg-type]


def test_info_names_what_the_contract_names(opened: Model, scan: PointBatch) -> None:
    info = opened.info
    assert info["complete"]
    assert info["samples"] == len(scan)
    assert info["attributes"] == list(scan.attributes)
    assert info["bounds"] == [scan.xyz.min(axis=0).tolist(), scan.xyz.max(axis=0).tolist()]
    assert {"format", "clouds", "levels", "cloud_size", "bytes", "bits_per_sample", "spacing", "position_error", "crs",
            "left_out", "digest"} <= info.keys()  # fmt: skip


@pytest.mark.parametrize("length", [5000, 40_000, 65_536, 100_000])
def test_a_file_cut_short_gives_what_it_has(
    length: int, model: bytes, tmp_path: Path, clouds: tuple[IndexTree, list[PointBatch]]
) -> None:
    (tmp_path / "cut.lpc").write_bytes(model[:length])
    index, parts = clouds
    with pointstream.open(str(tmp_path / "cut.lpc")) as cut:
        assert not cut.info["complete"]
        here = np.flatnonzero(index.available(length))
        assert cut.info["here"] == {"samples": int(index.samples[here].sum()), "clouds": len(here)}
        points = cut.read()
    same(points, PointBatch.concatenate(parts[n] for n in np.flatnonzero(index.available(length))))


def test_the_same_over_http(path: Path, opened: Model) -> None:
    threads = threading.active_count()
    with serve_in_thread(path.parent) as url, pointstream.open(f"{url}/{path.name}") as remote:
        same(remote.read(), opened.read())
        box = [500_000.0, 4_000_000.0, 100.0, 500_100.0, 4_000_100.0, 130.0]
        same(remote.read(bounds=box, spacing=0.7), opened.read(bounds=box, spacing=0.7))
        first = next(iter(remote.batches()))
        assert len(first) == opened.index.samples[0]
        with pytest.raises(NotFound):
            pointstream.open(f"{url}/nothing.lpc")
    assert threading.active_count() == threads


def test_a_model_that_is_replaced_while_open_is_never_mixed(
    path: Path, tmp_path: Path, model: bytes, other_model: bytes
) -> None:
    file = tmp_path / "model.lpc"
    file.write_bytes(model)
    with serve_in_thread(tmp_path) as url, pointstream.open(f"{url}/model.lpc") as remote:
        (tmp_path / "new").write_bytes(other_model)
        (tmp_path / "new").replace(file)
        with pytest.raises(ModelChanged):
            remote.read()


def test_damage_is_an_error_that_names_the_place(
    model: bytes, tmp_path: Path, clouds: tuple[IndexTree, list[PointBatch]]
) -> None:
    damaged = bytearray(model)
    damaged[clouds[0].offset[9] + 12] ^= 128
    (tmp_path / "damaged.lpc").write_bytes(damaged)
    with (
        pointstream.open(str(tmp_path / "damaged.lpc")) as broken,
        pytest.raises(Corrupt, match="cloud 9: checksum differs"),
    ):
        broken.read()


def test_closed_is_closed(path: Path) -> None:
    model = pointstream.open(str(path))
    model.close()
    model.close()
    with pytest.raises(StoreError, match="closed"):
        model.read()
