"""Clouds that are guessed from their ancestors come back whole, whatever these are, and from both engines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import zstandard
from cloud_strategies import ATTRIBUTES, RawCloud, assert_same, random_codes, rows
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.cloud import read_cloud

from lpc.cloud import Cloud
from lpc.codec import decode_cloud, encode_cloud, encode_clouds
from lpc.context import ANCESTORS
from lpc.errors import Corrupt
from lpc.octahedral import encode_normals
from lpc.payload import CONTEXT

NORMAL, COLOR = ATTRIBUTES[0], ATTRIBUTES[2]
PREDICTION_AT = 5


def payload_of(frame: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(frame)


def decode_line(frames: list[bytes], family: list[RawCloud], engine: Any) -> list[Cloud]:
    """Decode ancestors one after another."""
    clouds: list[Cloud] = []
    for frame, raw in zip(frames, family, strict=True):
        clouds.append(decode_cloud(frame, samples=len(raw), schema=raw.schema, context=clouds, engine=engine))
    return clouds


def encode_line(family: list[RawCloud], **options: Any) -> list[bytes]:
    """Encode a chain of clouds, each the parent of the next."""
    lattice = np.concatenate([raw.lattice for raw in family])
    codes = {item.name: np.concatenate([raw.codes[item.name] for raw in family]) for item in family[0].schema}
    bounds = np.cumsum([0, *(len(raw) for raw in family)])
    parent = np.arange(len(family)) - 1
    return encode_clouds(lattice, codes, bounds, family[0].schema, parent=parent, **options)


@st.composite
def families(draw: st.DrawFn, most: int = 60) -> list[RawCloud]:
    """Chains of up to 7 clouds around one place, from coincident to 2**48 steps wide."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    schema = tuple(draw(st.lists(st.sampled_from(ATTRIBUTES), unique=True, min_size=1, max_size=3)))
    corner = np.array([draw(st.integers(-(2**51), 2**51)) for _ in range(3)])
    smooth = draw(st.booleans())
    family = []
    for _ in range(draw(st.integers(1, 7))):
        samples = draw(st.integers(1, most))
        extents = [1 << draw(st.sampled_from([0, 1, 3, 5, 7, 10, 13, 17, 24, 47])) for _ in range(3)]
        lattice = np.stack([rng.integers(0, extent, samples) for extent in extents], axis=1) + corner
        codes = {attribute.name: random_codes(rng, attribute, samples, smooth) for attribute in schema}
        family.append(RawCloud(lattice=lattice, codes=codes, schema=schema))
    return family


@settings(max_examples=150)
@given(families())
def test_every_sample_comes_back_from_both_engines(family: list[RawCloud]) -> None:
    frames = encode_line(family)
    clouds = decode_line(frames, family, "compiled")
    for cloud, other, raw in zip(clouds, decode_line(frames, family, "numpy"), family, strict=True):
        assert_same(cloud, other)
        assert rows(cloud.lattice(), dict(cloud.codes)) == rows(raw.lattice, raw.codes)


@settings(max_examples=60)
@given(families(), st.randoms(use_true_random=False))
def test_bytes_depend_on_the_sets_of_samples_alone(family: list[RawCloud], random: Any) -> None:
    frames = encode_line(family)
    assert frames == encode_line(family, engine="numpy")
    shuffled = [raw.take(np.array(random.sample(range(len(raw)), len(raw)))) for raw in family]
    assert frames == encode_line(shuffled)
    clouds = decode_line(frames, family, "compiled")
    for number, raw in enumerate(family):  # as one by one, with ancestors as they were decoded
        assert frames[number] == encode_cloud(raw.lattice, raw.codes, raw.schema, context=clouds[:number])


@settings(max_examples=40)
@given(families(most=25))
def test_a_reader_written_from_the_specification_agrees(family: list[RawCloud]) -> None:
    frames = encode_line(family)
    entries = [attribute.to_json() for attribute in family[0].schema]
    told: list[dict[str, list[Any]]] = []
    for frame, cloud in zip(frames, decode_line(frames, family, "auto"), strict=True):
        told.append(read_cloud(frame, len(cloud), entries, told))
        assert cloud.lattice().tolist() == [list(point) for point in told[-1]["lattice"]]
        for name, values in cloud.codes.items():
            expected = np.array(told[-1][name], object).reshape(len(cloud), -1)
            assert values.reshape(len(cloud), -1).tolist() == expected.tolist()


def sphere(samples: int, seed: int) -> RawCloud:
    """Samples of a smooth surface with normals and colours that follow it."""
    normal = np.random.default_rng(seed).normal(size=(samples, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    codes = {
        "normal": encode_normals(normal),
        "color": np.clip(128 + 100 * normal, 0, 255).astype(np.uint8),
    }
    return RawCloud(lattice=np.rint(400 * normal).astype(np.int64), codes=codes, schema=(NORMAL, COLOR))


def test_ancestors_make_a_cloud_smaller() -> None:
    family = [sphere(1000, seed) for seed in range(3)]
    frames = encode_line(family)
    assert payload_of(frames[0])[PREDICTION_AT] != CONTEXT
    assert payload_of(frames[1])[PREDICTION_AT] == payload_of(frames[2])[PREDICTION_AT] == CONTEXT
    assert len(frames[2]) < len(frames[1]) < 0.9 * len(frames[0])


def test_only_the_last_ancestors_count() -> None:
    family = [sphere(200, seed) for seed in range(ANCESTORS + 3)]
    frames = encode_line(family)
    clouds = decode_line(frames, family, "auto")
    last = decode_cloud(
        frames[-1], samples=200, schema=family[0].schema, context=clouds[-1 - ANCESTORS : -1], engine="numpy"
    )
    assert_same(last, clouds[-1])


@settings(max_examples=30)
@given(families())
def test_fast_takes_no_context_and_flips_nothing(family: list[RawCloud]) -> None:
    frames = encode_line(family, effort="fast")
    assert frames == encode_line(family, effort="fast", engine="numpy")
    for frame, raw in zip(frames, family, strict=True):
        axes, prediction = payload_of(frame)[1], payload_of(frame)[PREDICTION_AT]
        assert axes < 4
        assert prediction != CONTEXT
        alone = decode_cloud(frame, samples=len(raw), schema=raw.schema, context=None)
        assert rows(alone.lattice(), dict(alone.codes)) == rows(raw.lattice, raw.codes)


def test_a_context_where_the_header_promises_none_is_corrupt() -> None:
    family = [sphere(300, seed) for seed in range(2)]
    with pytest.raises(Corrupt, match="the header says that none is"):
        decode_cloud(encode_line(family)[1], samples=300, schema=family[0].schema, context=None)


def test_ancestors_elsewhere_are_no_context() -> None:
    near, far = sphere(300, 1), sphere(300, 2)
    moved = RawCloud(lattice=far.lattice + 10_000, codes=far.codes, schema=far.schema)
    assert encode_line([moved, near])[1] == encode_line([near])[0]


@pytest.mark.parametrize("engine", ["compiled", "numpy"])
def test_without_its_ancestors_a_cloud_is_other_normals_or_corrupt(engine: Any) -> None:
    family = [sphere(500, seed) for seed in range(2)]
    frame = encode_line(family)[1]
    try:
        cloud = decode_cloud(frame, samples=500, schema=family[0].schema, engine=engine)
    except Corrupt:
        return
    assert rows(cloud.lattice(), {}) == rows(family[1].lattice, {})


@settings(max_examples=200)
@given(families(most=30), st.data())
def test_a_changed_payload_is_corrupt_or_a_cloud(family: list[RawCloud], data: st.DataObject) -> None:
    frames = encode_line(family)
    clouds = decode_line(frames, family, "auto")
    payload = bytearray(payload_of(frames[-1]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(payload) - 1))
        payload[at] = data.draw(st.one_of(st.integers(0, 255), st.just(payload[at] ^ 1)))
    frame = zstandard.ZstdCompressor(write_checksum=True).compress(bytes(payload))
    told: list[Any] = []
    for engine in ("compiled", "numpy"):
        try:
            told.append(
                decode_cloud(
                    frame,
                    samples=len(family[-1]),
                    schema=family[0].schema,
                    context=clouds[:-1],
                    engine=engine,  # type: ignore[arg-type]
                )
            )
        except Corrupt as error:
            told.append(str(error))
    if isinstance(told[0], str) or isinstance(told[1], str):
        assert told[0] == told[1]
    else:
        assert_same(told[0], told[1])
