"""Bytes that are no cloud: `Corrupt` from both engines; no other exception, no crash, no large allocation."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zstandard
from cloud_strategies import ATTRIBUTES, RawCloud, random_codes, raw_clouds
from hypothesis import given, settings
from hypothesis import strategies as st

from lpc.channels import channels_of
from lpc.codec import decode_cloud, encode_cloud
from lpc.errors import Corrupt
from lpc.payload import largest_payload

if TYPE_CHECKING:
    from lpc.attributes import Schema
    from lpc.cloud import Cloud

NORMAL = ATTRIBUTES[0]
SAMPLES = 40


def frame_of(payload: bytes, **options: Any) -> bytes:
    """A frame with a checksum that is right, around any payload."""
    return zstandard.ZstdCompressor(**{"write_checksum": True, **options}).compress(payload)


def payload_of(frame: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(frame)


def good(samples: int = SAMPLES) -> bytes:
    rng = np.random.default_rng(samples)
    codes = {"normal": random_codes(rng, NORMAL, samples, True)}
    return encode_cloud(rng.integers(0, 300, (samples, 3)), codes, (NORMAL,))


def decode_or_corrupt(frame: bytes, samples: int, schema: Schema) -> Cloud | None:
    """Both engines must say the same."""
    results: list[Cloud | str] = []
    for engine in ("compiled", "numpy"):
        try:
            results.append(decode_cloud(frame, samples=samples, schema=schema, engine=engine))  # type: ignore[arg-type]
        except Corrupt as error:
            results.append(str(error))
    first, second = results
    if isinstance(first, str) or isinstance(second, str):
        assert first == second
        assert "\n" not in str(first)
        return None
    assert len(first) == samples
    np.testing.assert_array_equal(first.lattice(), second.lattice())
    assert np.abs(first.lattice()).max() < 2**52
    for attribute in schema:
        codes = first.codes[attribute.name]
        np.testing.assert_array_equal(codes, second.codes[attribute.name])
        assert int(codes.max()) < 1 << attribute.bits
    return first


@settings(max_examples=200)
@given(raw_clouds(most=60), st.data())
def test_a_changed_frame_is_noticed(cloud: RawCloud, data: st.DataObject) -> None:
    frame = bytearray(encode_cloud(cloud.lattice, cloud.codes, cloud.schema))
    at = data.draw(st.integers(0, len(frame) - 1))
    change = data.draw(st.sampled_from(["flip", "cut", "append", "insert"]))
    if change == "flip":
        frame[at] ^= 1 << data.draw(st.integers(0, 7))
    elif change == "cut":
        del frame[at:]
    elif change == "append":
        frame += frame[: at + 1]
    else:
        frame.insert(at, data.draw(st.integers(0, 255)))
    changed = decode_or_corrupt(bytes(frame), len(cloud), cloud.schema)
    if changed is not None:  # bits of a frame that mean nothing
        before = decode_cloud(
            encode_cloud(cloud.lattice, cloud.codes, cloud.schema), samples=len(cloud), schema=cloud.schema
        )
        np.testing.assert_array_equal(changed.lattice(), before.lattice())


@settings(max_examples=300)
@given(raw_clouds(most=60), st.data())
def test_a_changed_payload_is_corrupt_or_a_cloud(cloud: RawCloud, data: st.DataObject) -> None:
    payload = bytearray(payload_of(encode_cloud(cloud.lattice, cloud.codes, cloud.schema)))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.one_of(st.integers(0, len(payload) - 1), st.integers(0, min(28, len(payload) - 1))))
        payload[at] = data.draw(st.one_of(st.integers(0, 255), st.just(payload[at] ^ 1)))
    decode_or_corrupt(frame_of(bytes(payload)), len(cloud), cloud.schema)


@settings(max_examples=200)
@given(st.binary(max_size=400), st.integers(-1, 50), st.sampled_from([(), (NORMAL,), ATTRIBUTES]))
def test_noise_is_corrupt_or_a_cloud(noise: bytes, samples: int, schema: Schema) -> None:
    decode_or_corrupt(noise, samples, schema)
    decode_or_corrupt(frame_of(noise), samples, schema)
    decode_or_corrupt(frame_of(b"\2" + noise), samples, schema)


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, 1, "codec 1"),
        (1, 3, "header"),
        (1, 32, "header"),
        (2, 17, "17 \\+ 0 bits"),
        (3, 1, "bits a coordinate"),
        (3, 33, "bits a coordinate"),
        (4, 65, "header"),
        (5, 7, "header"),
        (6, 8, "header"),
    ],
)
def test_every_field_of_the_header_is_checked(at: int, value: int, words: str) -> None:
    payload = bytearray(payload_of(good()))
    payload[at] = value
    for engine in ("compiled", "numpy"):
        with pytest.raises(Corrupt, match=words):
            decode_cloud(frame_of(bytes(payload)), samples=SAMPLES, schema=(NORMAL,), engine=engine)  # type: ignore[arg-type]


@pytest.mark.parametrize("samples", [SAMPLES - 1, SAMPLES + 1, 2**20, 2**20 + 1, 0, -1])
def test_another_number_of_samples_is_corrupt(samples: int) -> None:
    assert decode_or_corrupt(good(), samples, (NORMAL,)) is None


@pytest.mark.parametrize("schema", [(), ATTRIBUTES, (NORMAL, NORMAL)])
def test_another_schema_is_corrupt(schema: Schema) -> None:
    assert decode_or_corrupt(good(), SAMPLES, schema) is None


def test_a_corner_outside_the_lattice_is_corrupt() -> None:
    def payload(corner: int, width: int) -> bytes:
        return bytes([2, 0, 0, 0, 0, 0, width]) + corner.to_bytes(width, "little", signed=True) * 3 + b"\0"

    assert decode_or_corrupt(frame_of(payload(2**52 - 2, 7)), 1, ()) is not None
    assert decode_or_corrupt(frame_of(payload(-(2**52) + 1, 7)), 1, ()) is not None
    assert decode_or_corrupt(frame_of(payload(0, 0)), 1, ()) is not None
    assert decode_or_corrupt(frame_of(payload(2**52 - 1, 7)), 1, ()) is None
    assert decode_or_corrupt(frame_of(payload(-(2**52), 7)), 1, ()) is None
    assert decode_or_corrupt(frame_of(payload(-(2**55), 7)), 1, ()) is None


def test_positions_cannot_leave_their_bits_nor_wrap_around() -> None:
    # each of 2**16 + 1 differences is the largest there is: their sum passes 2**64 and comes back small
    samples = 2**16 + 1
    raw = ((1 << (46 * samples)) - 1).to_bytes((46 * samples + 7) // 8, "little")
    head = bytes([2, 0, 16, 0, 0, 0, 1]) + bytes(3)
    assert decode_or_corrupt(frame_of(head + raw + bytes([95]) * samples), samples, ()) is None

    head = bytes([2, 0, 1, 0, 0, 0, 1]) + bytes(3)  # nbits 1: codes up to 7
    assert decode_or_corrupt(frame_of(head + b"\3" + bytes([5])), 1, ()) is not None
    assert decode_or_corrupt(frame_of(head + b"\3" + bytes([5, 1])), 2, ()) is None
    assert decode_or_corrupt(frame_of(head + b"\3" + bytes([6])), 1, ()) is None


def test_a_code_that_is_no_normals_is_corrupt() -> None:
    def payload(number: int) -> bytes:  # 128 to 255: a token and 6 raw bits
        raw, token = number & 63, ((6 + 1) << 1) | (number >> 6 & 1)
        return bytes([2, 0, 0, 0, 0, 0, 1]) + bytes(3) + bytes([raw]) + bytes([0, token, 0])

    cloud = decode_or_corrupt(frame_of(payload(254)), 1, (NORMAL,))
    assert cloud is not None
    assert cloud.codes["normal"].tolist() == [[254, 127]]
    assert decode_or_corrupt(frame_of(payload(255)), 1, (NORMAL,)) is None  # 127 - 128 modulo 256


def test_declared_sizes_are_bounded_before_anything_is_allocated() -> None:
    limit = largest_payload(SAMPLES, channels_of((NORMAL,)))
    for size in (limit + 1, 2**31, 2**40, 2**63, 2**64 - 2):
        frame = struct.pack("<IBQ", 0xFD2FB528, 0xE4, size) + b"\1\0\0" + bytes(4)
        with pytest.raises(Corrupt, match="declares"):
            decode_cloud(frame, samples=SAMPLES, schema=(NORMAL,))
    bomb = frame_of(bytes(10**7))
    with pytest.raises(Corrupt, match="declares 10000000 bytes"):
        decode_cloud(bomb, samples=SAMPLES, schema=(NORMAL,))


def test_no_cloud_is_larger_than_the_largest() -> None:
    rng = np.random.default_rng(5)
    lattice = rng.integers(-(2**47), 2**47, (300, 3))
    codes = {attribute.name: random_codes(rng, attribute, 300, False) for attribute in ATTRIBUTES}
    size = len(payload_of(encode_cloud(lattice, codes, ATTRIBUTES)))
    assert 0.9 * size < largest_payload(300, channels_of(ATTRIBUTES)) < 1.3 * size


def test_frames_that_zstd_accepts_and_the_format_does_not() -> None:
    frame, payload = good(), payload_of(good())
    trained = zstandard.ZstdCompressionDict(payload * 20, dict_type=zstandard.DICT_TYPE_RAWCONTENT)
    skippable = struct.pack("<II", 0x184D2A50, 4) + b"skip"
    frames = {
        "no checksum": frame_of(payload, write_checksum=False),
        "no size": frame_of(payload, write_content_size=False),
        "a second frame": frame + frame,
        "bytes after it": frame + b"\0",
        "a skippable frame first": skippable + frame,
        "a dictionary": frame_of(payload, dict_data=trained),
        "the number of a dictionary": struct.pack("<IBBB", 0xFD2FB528, 0x25, 7, 40) + b"\1\0\0" + bytes(4),
        "nothing": b"",
        "empty": frame_of(b""),
    }
    for name, bad in frames.items():
        assert decode_or_corrupt(bad, SAMPLES, (NORMAL,)) is None, name
    assert decode_or_corrupt(frame, SAMPLES, (NORMAL,)) is not None
