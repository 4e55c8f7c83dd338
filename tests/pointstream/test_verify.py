"""`verify` finds what is wrong, and only that."""

from __future__ import annotations

import asyncio
import time
import zlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.build import build_bytes
from support.frames import subtrees, whole_index

from lpc.header import parse_header, seal
from lpc.index import IndexTree
from lpc.lattice import quantise
from lpc.page import RECORD, pack_pages
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointstream.matching import Matcher
from pointstream.reading import Reader
from pointstream.stores import MemoryStore
from pointstream.verify import VerifyReport, verify

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@dataclass
class Info:
    attributes: dict[str, np.dtype[Any]]


class ListedScan:
    """Samples as a scan."""

    def __init__(self, points: PointBatch) -> None:
        self.points = points
        self.info = Info({name: values.dtype for name, values in points.attributes.items()})

    def batches(self, size: int) -> Iterator[PointBatch]:
        for start in range(0, len(self.points), 3000):
            yield self.points.take(slice(start, start + 3000))


def check(data: bytes, *scans: PointBatch) -> VerifyReport:
    async def run() -> VerifyReport:
        reader = await Reader.open(MemoryStore(data))
        return await verify(reader, [ListedScan(points) for points in scans])

    return asyncio.run(run())


def rebuilt(data: bytes, change: Any) -> bytes:
    """The same file with changed records, checksums and digest made right again."""
    header = parse_header(data)
    index = IndexTree(header)
    records = np.zeros(header.nodes, RECORD)  # the unused bytes of a record are 0
    for page in range(header.pages):
        place = index.page_range(page)
        body = data[place.start : place.stop]
        index.add_page(page, body)
        first = page * header.page_nodes
        rows = np.frombuffer(body, RECORD, offset=48)
        records[first : first + len(rows)] = rows
    clouds = [data[index.offset[n] : index.offset[n] + index.size[n]] for n in range(header.nodes)]
    change(records, clouds)
    for record, cloud in zip(records, clouds, strict=True):
        record["size"], record["crc"] = len(cloud), zlib.crc32(cloud)
    header = seal(header, records)
    parts = [header.to_bytes()]
    for number, (_, page) in enumerate(pack_pages(header.tag, records, header.page_nodes, header.page0)):
        parts += [page, *clouds[number * header.page_nodes : (number + 1) * header.page_nodes]]
    return b"".join(parts)


def test_a_sound_model_passes(model: bytes, scan: PointBatch) -> None:
    report = check(model, scan)
    assert report.ok, report.problems
    assert report.clouds_checked == report.clouds == parse_header(model).nodes
    match = report.match
    assert match is not None
    assert (match.samples_in, match.samples_out, match.missing, match.surplus) == (20_000, 20_000, 0, 0)
    error = parse_header(model).position_error
    assert 0.5 * error < match.max_position_error <= error
    assert match.max_normal_error_degrees is not None
    assert 0.1 < match.max_normal_error_degrees < 1.0
    assert match.differing == {"normal": 0, "color": 0, "intensity": 0}
    assert rebuilt(model, lambda records, clouds: None) == model


def test_order_and_pieces_of_the_scans_do_not_matter(model: bytes, scan: PointBatch) -> None:
    shuffled = scan.take(np.random.default_rng(1).permutation(len(scan)))
    nan = PointBatch(np.full((5, 3), np.nan), {name: values[:5] for name, values in scan.attributes.items()})
    parts = shuffled.take(slice(0, 7000)), nan, shuffled.take(slice(7000, None))
    assert check(model, *parts).ok


def test_one_sample_more_less_or_moved_is_found(model: bytes, scan: PointBatch) -> None:
    less = check(model, scan.take(slice(1, None)))
    assert not less.ok
    assert less.match is not None
    assert (less.match.missing, less.match.surplus) == (0, 1)
    twice = check(model, scan, scan.take(slice(0, 1)))
    assert twice.match is not None
    assert (twice.match.missing, twice.match.surplus) == (1, 0)
    xyz = scan.xyz.copy()
    xyz[77] += 5 * parse_header(model).position_error
    moved = check(model, PointBatch(xyz, scan.attributes))
    assert moved.match is not None
    assert (moved.match.missing, moved.match.surplus) == (1, 1)
    assert any("1 of 20000 samples of the scans are not in the model" in text for text in moved.problems)


def test_wrong_attributes_are_found_even_among_coincident_samples(model: bytes, scan: PointBatch) -> None:
    for place in (5, 6670):
        color = scan.attributes["color"].copy()
        color[place, 1] ^= 1
        normal = scan.attributes["normal"].copy()
        normal[place] = -normal[place] if normal[place].any() else (0, 0, 1)
        report = check(model, PointBatch(scan.xyz, {**scan.attributes, "color": color, "normal": normal}))
        assert report.match is not None
        assert report.match.missing == 0
        assert report.match.differing["color"] == 1
        assert any(text.startswith("color differs in 1 ") for text in report.problems)
        assert any("normal" in text for text in report.problems)


def test_attributes_that_the_scan_lacks_are_not_compared(model: bytes, scan: PointBatch) -> None:
    report = check(model, PointBatch(scan.xyz, {}))
    assert report.ok
    assert report.to_json()["max_normal_error_degrees"] is None


def test_every_attribute_that_both_have_is_compared_and_the_others_are_named(scan: PointBatch, tmp_path: Path) -> None:
    """Scalars of any name and type, and those that the header holds because they have one value everywhere."""
    n = len(scan)
    values = {
        **scan.attributes,
        "gps_time": np.random.default_rng(3).uniform(0, 1e9, n),
        "source": np.full(n, 7, np.uint16),
        "only_here": np.arange(n, dtype=np.int32),
        "widened": np.arange(n, dtype=np.int32),
    }
    scans, options = [ArrayScan(PointBatch(scan.xyz, values))], BuildOptions(threads=1, attributes=("all",))
    build_model(scans, tmp_path / "m.lpc", options, clock=time.monotonic)
    data = (tmp_path / "m.lpc").read_bytes()
    assert "source" in parse_header(data).constants
    values.pop("only_here")
    values["widened"] = values["widened"].astype(np.int64)
    report = check(data, PointBatch(scan.xyz, values))
    assert report.ok, report.problems
    entry = report.to_json()
    assert entry["attributes_differing"] == dict.fromkeys(["normal", "color", "intensity", "gps_time", "source"], 0)
    assert entry["not_compared"] == {
        "only_here": "not in the scans",
        "widened": "int32 in the model, int64 in the scans",
    }
    # Samples at a place of their own: which of several is which, only what they carry tells.
    places = np.rint(scan.xyz / parse_header(data).step)
    _, place, sharing = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    chosen = (np.arange(n) % 100 == 5) & (sharing[place] == 1)
    for name, wrong in (("gps_time", np.nextafter(values["gps_time"], 0)), ("source", values["source"] + 1)):
        changed = np.where(chosen, wrong, values[name]).astype(values[name].dtype)
        report = check(data, PointBatch(scan.xyz, {**values, name: changed}))
        assert report.problems == (f"{name} differs in {chosen.sum()} samples",)


def test_another_scan_shares_nothing(model: bytes, scan: PointBatch) -> None:
    report = check(model, PointBatch(scan.xyz * 1e30, scan.attributes))
    assert report.match is not None
    assert (report.match.missing, report.match.surplus) == (20_000, 20_000)


@pytest.mark.parametrize("length", [3000, 40_000, -1])
def test_a_cut_file_says_how_much_is_missing(length: int, model: bytes) -> None:
    report = check(model[:length])
    assert not report.ok
    assert not report.complete
    here = length % len(model)
    assert report.problems[0].startswith(f"the file is cut short: {here} of {len(model)} bytes are here")
    assert report.clouds_checked < report.clouds


def test_every_damaged_cloud_is_named(model: bytes) -> None:
    index = whole_index(model)
    damaged = bytearray(model)
    below = int(index.children[int(index.children[2, 1]), 0])  # what a damaged cloud tells is checked, too
    bad = [2, 11, below]
    for node in bad:
        damaged[index.offset[node] + 15] ^= 2
    report = check(bytes(damaged))
    assert [text.split(":")[0] for text in report.problems[:3]] == [f"cloud {node}" for node in sorted(bad)]
    untold = np.setdiff1d(subtrees(index, bad), bad)
    samples = int(index.samples[untold].sum())
    assert report.problems[3].startswith(f"{len(untold)} sound clouds of {samples:,} samples cannot be decoded")
    assert "the header says 20000" in report.problems[4]


def test_a_damaged_cloud_of_a_fast_model_takes_no_other_with_it(scan: PointBatch, tmp_path: Path) -> None:
    options = BuildOptions(threads=1, cloud_size=256, effort="fast")
    build_model([ArrayScan(scan)], tmp_path / "m.lpc", options, clock=time.monotonic)
    data = bytearray((tmp_path / "m.lpc").read_bytes())
    index = whole_index(bytes(data))
    data[index.offset[1] + 15] ^= 2
    report = check(bytes(data))
    left = len(scan) - int(index.samples[1])
    assert len(report.problems) == 2
    assert report.problems[0].startswith("cloud 1: checksum differs")
    assert report.problems[1].startswith(f"the clouds hold {left} samples")


def test_a_damaged_page_hides_its_clouds_and_the_rest_is_checked(model: bytes) -> None:
    header = parse_header(model)
    index = IndexTree(header)
    for page in range(header.pages - 1):
        place = index.page_range(page)
        index.add_page(page, model[place.start : place.stop])
    damaged = bytearray(model)
    damaged[index.page_range(header.pages - 1).start + 50] ^= 1
    report = check(bytes(damaged))
    assert report.clouds_checked == (header.pages - 1) * header.page_nodes
    assert f"page {header.pages - 1}" in report.problems[0]
    assert "cannot be found behind 1 damaged page" in report.problems[1]


def test_clouds_whose_ancestors_a_damaged_page_hides_are_told_of(model: bytes) -> None:
    header = parse_header(model)
    index = IndexTree(header)
    for page in range(header.pages):
        place = index.page_range(page)
        index.add_page(page, model[place.start : place.stop])
    damaged = bytearray(model)
    damaged[index.page_range(1).start + 50] ^= 1
    nodes = list(range(header.page_nodes, 2 * header.page_nodes))
    behind = np.setdiff1d(subtrees(index, nodes), nodes)
    report = check(bytes(damaged))
    hidden = header.nodes - report.clouds_checked
    assert f"{hidden} of {header.nodes} clouds cannot be found behind 1 damaged page" in report.problems[1]
    untold = len(behind) - (hidden - len(nodes))
    assert untold > 0
    assert report.problems[2].startswith(f"{untold} sound clouds of ")


def test_lies_under_right_checksums_are_found(model: bytes) -> None:
    def shrink(records: Any, clouds: Any) -> None:
        records["radius"][0] *= 0.9

    assert any("outside the sphere of node 0" in text for text in check(rebuilt(model, shrink)).problems)

    def narrow(records: Any, clouds: Any) -> None:
        coned = np.flatnonzero(records["cone_angle"] < 65535)
        records["cone_angle"][coned[-1]] = 0

    assert any("outside the cone of node" in text for text in check(rebuilt(model, narrow)).problems)

    header = parse_header(model)
    other_seed = replace(header, seed=99, digest=header.digest).to_bytes() + model[header.page0 :]
    if len(other_seed) == len(model):
        assert any("build id" in text for text in check(other_seed).problems)

    def swap(records: Any, clouds: Any) -> None:
        same = [n for n in range(len(records)) if records["samples"][n] == records["samples"][1]]
        clouds[1], clouds[same[-1]] = clouds[same[-1]], clouds[1]

    assert not check(rebuilt(model, swap)).ok


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 400), st.integers(0, 2**32 - 1), st.integers(1, 6), st.booleans())
def test_matching_is_that_of_multisets(
    tmp_path_factory: pytest.TempPathFactory, n: int, seed: int, side: int, all_same: bool
) -> None:
    """Few cells, many coincident samples, attributes that differ: counted with a plain dictionary."""
    rng = np.random.default_rng(seed)
    first = PointBatch(
        rng.integers(0, 1 if all_same else side, (n, 3)) + rng.uniform(-0.3, 0.3, (n, 3)),
        {"intensity": rng.integers(0, 3, n).astype(np.uint16)},
    )
    header = parse_header(build_bytes(first, step=1.0, spacing=2.0))
    kept = rng.random(n) < 0.7
    moved = first.xyz[kept] + (rng.random(kept.sum()) < 0.1)[:, None] * np.array([40.0, 0, 0])
    values = first.attributes["intensity"][kept]
    with Matcher(header, ["intensity"], tmp_path_factory.mktemp("buckets")) as matcher:
        matcher.add_in(moved, {"intensity": values})
        matcher.add_out(quantise(first.xyz, np.array(header.origin), 1.0), first.attributes)
        report = matcher.match()
    gone = int((moved[:, 0] > 30).sum())
    assert report.samples_in == len(moved)
    assert report.samples_out == n
    assert report.missing == gone
    assert report.surplus == n - len(moved) + gone
    assert report.differing == {"intensity": 0}


def test_samples_on_the_border_of_two_cells_find_their_neighbour(scan: PointBatch, tmp_path: Path) -> None:
    """Whoever rounds half up instead of half to even puts them one cell further."""
    xyz = np.array([[0.0, 0, 0], [0.5, 0, 0], [2.5, 1.5, 0], [4.0, 4.0, 4.0]])
    header = parse_header(build_bytes(PointBatch(xyz), step=1.0, spacing=2.0))
    upward = np.floor(xyz + 0.5).astype(np.int64)
    assert (upward != quantise(xyz, np.array(header.origin), 1.0)).any()
    with Matcher(header, [], tmp_path) as matcher:
        matcher.add_in(xyz, {})
        matcher.add_out(upward, {})
        report = matcher.match()
    assert (report.missing, report.surplus) == (0, 0)
