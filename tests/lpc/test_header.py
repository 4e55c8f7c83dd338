from __future__ import annotations

import hashlib
import json
import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import fake_models, headers

from lpc.attributes import Attribute
from lpc.constants import Constant
from lpc.errors import Corrupt, FormatError, NotAModel, Truncated, UnsupportedVersion
from lpc.header import MAX_TEXT, Header, compute_digest, parse_header

PLAIN = Header(
    bytes=10_000, samples=3000, nodes=3, levels=2, cloud_size=1000, page_nodes=2, origin=(0.0, 0.0, 0.0), step=0.5,
    side=100.0, bounds=(0.0, 0.0, 0.0, 99.0, 50.0, 1.0), spacing=1.0, position_error=0.44,
    attributes=(Attribute(name="normal", kind="normal", dtype="<f4", bits=8),),
    constants={"classification": Constant("<u1", 6)},
)  # fmt: skip


def file_of(text: bytes, *, major: int = 2, minor: int = 0) -> bytes:
    head = struct.pack("<8sHHIII", b"\x89LPC\r\n\x1a\n", major, minor, len(text), zlib.crc32(text), 0) + text
    return head.ljust(-(-len(head) // 8) * 8, b"\0")


def altered(**changes: Any) -> bytes:
    entry = PLAIN.to_json() | changes
    return file_of(json.dumps({key: value for key, value in entry.items() if value is not ...}).encode())


@given(headers())
def test_what_is_written_is_read(header: Header) -> None:
    data = header.to_bytes()
    again = parse_header(data + b"what follows")
    assert again == header
    assert again.to_bytes() == data
    assert again.page0 == header.page0 == len(data)
    assert len(data) % 8 == 0
    assert again.digest_text == header.digest_text


@given(headers(), st.data())
def test_a_prefix_says_how_many_bytes_it_takes(header: Header, data: st.DataObject) -> None:
    whole = header.to_bytes()
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(Truncated) as caught:
        parse_header(whole[:cut])
    assert cut < caught.value.needed <= len(whole)
    assert cut < 24 or caught.value.needed == len(whole)


def test_the_bytes_are_those_of_the_specification() -> None:
    data = PLAIN.to_bytes()
    magic, major, minor, length, crc, zero = struct.unpack_from("<8sHHIII", data)
    text = data[24 : 24 + length]
    assert (magic, major, minor, zero) == (b"\x89LPC\r\n\x1a\n", 2, 0, 0)
    assert crc == zlib.crc32(text)
    assert not data[24 + length :].strip(b"\0")
    entry = json.loads(text)
    assert list(entry) == sorted(entry)
    assert entry["constants"] == {"classification": {"dtype": "<u1", "value": 6}}
    assert entry["bounds"] == [0.0, 0.0, 0.0, 99.0, 50.0, 1.0]


def test_other_files_are_no_models() -> None:
    for data in (b"ply\n", b"PK\x03\x04" + bytes(100), b"\x89LPC\n\x1a\n" + bytes(100), b"<!DOCTYPE html>"):
        with pytest.raises(NotAModel):
            parse_header(data)


def test_another_major_version_is_refused_and_a_newer_minor_one_read() -> None:
    text = json.dumps(PLAIN.to_json() | {"later": [1, 2]}).encode()
    with pytest.raises(UnsupportedVersion, match="version 3, this program reads 2: update it"):
        parse_header(file_of(text, major=3))
    with pytest.raises(UnsupportedVersion, match="version 1, this program reads 2: build the model again"):
        parse_header(file_of(text, major=1))
    header = parse_header(file_of(text, minor=7))
    assert header.extra == {"later": [1, 2]}
    assert header.samples == PLAIN.samples


def test_a_flipped_bit_is_found() -> None:
    data = bytearray(PLAIN.to_bytes())
    data[100] ^= 1
    with pytest.raises(Corrupt, match="checksum"):
        parse_header(bytes(data))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"samples": ...}, "samples"), ({"crs": ...}, "crs"),
        ({"samples": 0}, "samples"), ({"samples": 2}, "samples"), ({"samples": 2.0}, "samples"),
        ({"samples": True}, "samples"), ({"samples": "many"}, "samples"), ({"samples": 10**30}, "samples"),
        ({"nodes": 2**31}, "nodes"), ({"nodes": 0}, "nodes"), ({"nodes": -1}, "nodes"),
        ({"nodes": 10**6, "samples": 10**9}, "bytes"), ({"bytes": 300}, "bytes"),
        ({"levels": 4}, "levels"), ({"levels": 257, "nodes": 300, "bytes": 10**6}, "levels"),
        ({"page_nodes": 0}, "page_nodes"), ({"page_nodes": 4097}, "page_nodes"),
        ({"cloud_size": 2**20 + 1}, "cloud_size"),
        ({"origin": [0, 0]}, "origin"), ({"origin": "abc"}, "origin"), ({"origin": [0, 0, None]}, "origin"),
        ({"bounds": [0, 0, 0, 1, -1, 1]}, "bounds"), ({"bounds": [0, 0, 0, 1, 1, 101]}, "bounds"),
        ({"bounds": [-1, 0, 0, 1, 1, 1]}, "bounds"),
        ({"step": 0}, "step"), ({"step": -1}, "step"), ({"side": 0}, "side"), ({"spacing": "1"}, "spacing"),
        ({"digest": "0" * 31}, "digest"), ({"digest": "G" * 32}, "digest"), ({"digest": 5}, "digest"),
        ({"attributes": {}}, "attributes"), ({"attributes": [1]}, "attributes"), ({"attributes": [{}]}, "attribute"),
        ({"attributes": [PLAIN.attributes[0].to_json()] * 2}, "twice"),
        ({"attributes": [PLAIN.attributes[0].to_json()] * 65}, "64"),
        ({"constants": {"normal": {"dtype": "<f4", "value": [0, 0, 1]}}}, "twice"),
        ({"constants": {"a": {"dtype": "<u1", "value": 256}}}, "constant"),
        ({"constants": {"a": {"dtype": "<u1", "value": -1}}}, "constant"),
        ({"constants": {"a": {"dtype": "<f4", "value": 1e300}}}, "constant"),
        ({"constants": {"a": {"dtype": "O", "value": 1}}}, "constant"),
        ({"constants": {"a": {"dtype": "<f4", "value": "x"}}}, "constant"),
        ({"constants": {"a": {"dtype": "<f4", "value": []}}}, "constant"),
        ({"constants": {"a": 1}}, "constant"), ({"constants": []}, "constants"),
        ({"constants": {"": {"dtype": "<f4", "value": 1}}}, "names"),
        ({"left_out": {"x": 1}}, "left_out"), ({"rejected": {"x": "1"}}, "rejected"),
        ({"bits_per_sample": {"x": "1"}}, "bits_per_sample"), ({"crs": 1}, "crs"), ({"seed": 2**64}, "seed"),
    ],
)  # fmt: skip
def test_values_that_cannot_be_true_are_named(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(Corrupt, match=named):
        parse_header(altered(**changes))


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"{",
        b"\xff\xfe",
        b"[" * 40_000,
        b'{"a": NaN}',
        b'{"samples": ' + b"9" * 5000 + b"}",
        b'{"a": 1e999}',
    ],
)
def test_text_that_is_no_header_is_corrupt(text: bytes) -> None:
    with pytest.raises(Corrupt):
        parse_header(file_of(text))


def test_infinity_by_overflow_is_no_length() -> None:
    text = json.dumps(PLAIN.to_json()).replace('"step": 0.5', '"step": 1e999')
    with pytest.raises(Corrupt, match="step"):
        parse_header(file_of(text.encode()))


def test_a_text_length_beyond_the_limit_is_refused_unread() -> None:
    with pytest.raises(Corrupt, match="at most"):
        parse_header(struct.pack("<8sHHIII", b"\x89LPC\r\n\x1a\n", 2, 0, MAX_TEXT + 1, 0, 0))
    with pytest.raises(FormatError, match="shorten"):
        replace(PLAIN, bytes=10**6, crs="x" * MAX_TEXT).to_bytes()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(st.sampled_from(sorted(PLAIN.to_json())), JSON)
def test_any_value_of_any_key_gives_a_header_or_a_format_error(key: str, value: Any) -> None:
    try:
        header = parse_header(altered(**{key: value}))
    except FormatError:
        return
    parse_header(header.to_bytes())


@given(st.dictionaries(st.sampled_from(["dtype", "value", "name", "kind", "bits", "offset", "scale"]), JSON))
def test_any_attribute_or_constant_gives_a_header_or_a_format_error(entry: dict[str, Any]) -> None:
    plain = PLAIN.attributes[0].to_json()
    for changes in ({"attributes": [plain | entry]}, {"constants": {"a": {"dtype": "<i4", "value": 1} | entry}}):
        try:
            header = parse_header(altered(**changes))
        except FormatError:
            continue
        for constant in header.constants.values():
            assert len(constant.fill(3)) == 3


def test_a_constant_costs_nothing_and_has_its_type() -> None:
    label = Constant("<u1", 6).fill(10**12)
    assert label.shape == (10**12,)
    assert label.dtype == np.uint8
    assert Constant("<f4", (0, 0, 1.0)).fill(2).tolist() == [[0, 0, 1], [0, 0, 1]]


@given(fake_models(max_nodes=30), st.integers(1, 9))
def test_the_digest_is_over_text_and_records_and_depends_on_both(model: Any, cut: int) -> None:
    header, records = model.header, model.records
    text = header.to_bytes()[24:].rstrip(b"\0")
    plain = text.replace(f'"digest":"{header.digest}",'.encode(), b"")
    assert len(plain) == len(text) - 44
    assert header.digest == hashlib.blake2b(plain + records.tobytes(), digest_size=16).hexdigest()
    assert compute_digest(header, [records[:cut], records[cut:].tobytes()]) == header.digest
    assert compute_digest(replace(header, seed=header.seed + 1), [records]) != header.digest
    changed = records.copy()
    changed["crc"][-1] ^= 1
    assert compute_digest(header, [changed]) != header.digest
    assert header.tag == bytes.fromhex(header.digest)[:8]
    assert header.bytes == len(model.data)


def test_a_header_of_another_writer_keeps_its_place_and_digest() -> None:
    spaced = json.dumps(PLAIN.to_json(), sort_keys=True, indent=1).encode()
    header = parse_header(file_of(spaced))
    assert header == PLAIN
    assert header.page0 == -(-(24 + len(spaced)) // 8) * 8
    assert header.digest_text == spaced  # nothing to cut out: this writer spaces the digest otherwise
