from __future__ import annotations

import struct
import zlib
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FakeModel, fake_model, fake_models, random_records

from lpc.errors import Corrupt, FormatError, Truncated
from lpc.page import PAGE_HEADER, RECORD, child_page_numbers, page_bytes, page_offsets, parse_page

SHAPE = [3, 3, 3, 3, 3, 0, 2, 1, 3]


def model(page_nodes: int = 4) -> FakeModel:
    rng = np.random.default_rng(5)
    return fake_model(random_records(SHAPE, rng), page_nodes, rng)


def repacked(page: bytes, offset: int, value: bytes) -> bytes:
    """The page with other bytes at `offset` and a checksum that holds again."""
    changed = bytearray(page)
    changed[offset : offset + len(value)] = value
    struct.pack_into("<I", changed, 20, zlib.crc32(changed[24:], zlib.crc32(changed[:20])))
    return bytes(changed)


def test_the_record_is_that_of_the_specification() -> None:
    record = np.zeros(1, RECORD)
    record["center"], record["radius"], record["spacing"] = (1, 2, 3), 4.5, 5.5
    record["samples"], record["subtree"], record["size"], record["crc"] = 6, 7, 8, 9
    record["cone_axis"], record["cone_angle"], record["children"] = (10, 11), 12, 3
    assert record.tobytes() == struct.pack("<3IffIQII2BHB3x", 1, 2, 3, 4.5, 5.5, 6, 7, 8, 9, 10, 11, 12, 3)


@given(fake_models())
def test_pages_read_back_and_stand_where_the_file_has_them(model: FakeModel) -> None:
    header = model.header
    offsets = page_offsets(model.records, header.page_nodes, header.page0)
    assert len(model.pages) == header.pages
    assert offsets[-1] == header.bytes == len(model.data)
    first_child = 1
    for number, (offset, packed) in enumerate(model.pages):
        assert offset == offsets[number]
        assert len(packed) == page_bytes(header, number)
        page = parse_page(model.data[offset:], header, number)
        start = number * header.page_nodes
        assert page.first_node == start
        assert page.first_child == first_child
        assert page.records.tobytes() == model.records[start : start + header.page_nodes].tobytes()
        first_child += sum(int(bits).bit_count() for bits in page.records["children"])
        holders = {child // header.page_nodes for child in range(page.first_child, first_child)} - {number}
        named = {page.first_child // header.page_nodes + slot for slot, place in enumerate(page.child_pages) if place}
        assert named == holders
        assert all(model.data[place : place + 8] == header.tag for place in page.child_pages if place)


@given(st.integers(0, 50), st.integers(1, 60), st.integers(0, 40), st.integers(1, 20))
def test_three_slots_are_enough(page: int, ahead: int, children: int, page_nodes: int) -> None:
    first_child = page * page_nodes + ahead
    children = min(children, 2 * page_nodes)
    numbers = child_page_numbers(page, first_child, children, page_nodes)
    wanted = {child // page_nodes for child in range(first_child, first_child + children)}
    assert {number for number in numbers if number >= 0} == wanted - {page}


@given(st.data())
def test_a_short_page_says_how_many_bytes_it_takes(data: st.DataObject) -> None:
    whole = model()
    _, packed = whole.pages[1]
    cut = data.draw(st.integers(0, len(packed) - 1))
    with pytest.raises(Truncated) as caught:
        parse_page(packed[:cut], whole.header, 1)
    assert caught.value.needed == len(packed)


@pytest.mark.parametrize("at", [0, 8, 12, 16, 20, 24, 48, 60, 100])
def test_a_flipped_bit_is_found_anywhere(at: int) -> None:
    whole = model()
    damaged = bytearray(whole.pages[1][1])
    damaged[at] ^= 4
    with pytest.raises(Corrupt):
        parse_page(bytes(damaged), whole.header, 1)


def test_a_page_of_another_build_is_refused_by_its_tag() -> None:
    whole = model()
    other = replace(whole.header, digest="f" * 32)
    with pytest.raises(Corrupt, match="another build"):
        parse_page(whole.pages[0][1], other, 0)


def test_a_page_is_not_taken_for_another() -> None:
    whole = model()
    with pytest.raises(Corrupt, match="holds 4 nodes from 4"):
        parse_page(whole.pages[1][1], whole.header, 0)
    with pytest.raises(ValueError, match="page 99"):
        parse_page(whole.pages[1][1], whole.header, 99)


@pytest.mark.parametrize(
    ("offset", "value", "named"),
    [
        (12, struct.pack("<I", 3), "nodes"),
        (16, struct.pack("<I", 4), "children"), (16, struct.pack("<I", 10**9), "children"),
        (24, struct.pack("<Q", 0), "offsets"), (40, struct.pack("<Q", 500), "offsets"),
        (48 + 12, struct.pack("<f", float("nan")), "radius"), (48 + 12, struct.pack("<f", -1), "radius"),
        (48 + 12, struct.pack("<f", float("inf")), "radius"), (48 + 16, struct.pack("<f", float("inf")), "spacing"),
        (48 + 16, struct.pack("<f", -0.5), "spacing"),
        (48 + 20, struct.pack("<I", 0), "samples"), (48 + 20, struct.pack("<I", 65536), "samples"),
        (48 + 24, struct.pack("<Q", 2**63), "subtree"), (48 + 24, struct.pack("<Q", 1), "subtree"),
        (48 + 32, struct.pack("<I", 15), "bytes"), (48 + 44, b"\x04", "children"),
        (48 + 44, b"\x00", "subtree"),
    ],
)  # fmt: skip
def test_records_that_cannot_be_true_are_named(offset: int, value: bytes, named: str) -> None:
    whole = model()
    with pytest.raises(Corrupt, match=named):
        parse_page(repacked(whole.pages[1][1], offset, value), whole.header, 1)


def test_a_leaf_of_coincident_samples_may_exceed_the_cloud_size() -> None:
    whole = model(page_nodes=100)
    leaf = len(whole.records) - 1
    place = PAGE_HEADER + RECORD.itemsize * leaf
    big = replace(whole.header, samples=2**30)
    page = repacked(whole.pages[0][1], place + 20, struct.pack("<IQ", 5000, 5000))
    assert parse_page(page, big, 0).records["samples"][leaf] == 5000
    page = repacked(whole.pages[0][1], place + 20, struct.pack("<IQ", 2**20 + 1, 2**20 + 1))
    with pytest.raises(Corrupt, match="samples"):
        parse_page(page, big, 0)


@given(fake_models(max_nodes=20), st.data())
def test_whatever_stands_in_a_page_only_format_errors_come_out(model: FakeModel, data: Any) -> None:
    number = data.draw(st.integers(0, len(model.pages) - 1))
    packed = model.pages[number][1]
    offset = data.draw(st.integers(8, len(packed) - 1))
    value = data.draw(st.binary(min_size=1, max_size=min(8, len(packed) - offset)))
    with suppress(FormatError):
        parse_page(repacked(packed, offset, value), model.header, number)


@given(st.binary(max_size=400))
def test_garbage_is_no_page(garbage: bytes) -> None:
    with pytest.raises(FormatError):
        parse_page(garbage, model().header, 0)
