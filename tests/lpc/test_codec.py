"""Clouds go in and come out: every sample, from every engine, whatever their order."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cloud_strategies import ATTRIBUTES, RawCloud, assert_same, random_codes, raw_clouds, rows
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.cloud import read_cloud

from lpc import codec, codec_compiled, codec_numpy
from lpc.attributes import Attribute
from lpc.channels import channels_of, to_channels
from lpc.cloud import Cloud
from lpc.codec import cloud_to_points, decode_cloud, encode_cloud, encode_clouds
from lpc.constants import Constant
from lpc.octahedral import decode_normals, encode_normals
from lpc.payload import pack_header, parse_layout

NORMAL = ATTRIBUTES[0]


def encode(cloud: RawCloud, **options: Any) -> bytes:
    return encode_cloud(cloud.lattice, cloud.codes, cloud.schema, **options)


@given(raw_clouds())
def test_every_sample_comes_back_from_both_engines(cloud: RawCloud) -> None:
    frame = encode(cloud)
    decoded = decode_cloud(frame, samples=len(cloud), schema=cloud.schema, engine="compiled")
    assert rows(decoded.lattice(), dict(decoded.codes)) == rows(cloud.lattice, cloud.codes)
    assert_same(decoded, decode_cloud(frame, samples=len(cloud), schema=cloud.schema, engine="numpy"))
    for attribute in cloud.schema:
        assert decoded.codes[attribute.name].dtype == attribute.code_dtype


@given(raw_clouds(), st.randoms(use_true_random=False))
def test_bytes_depend_on_the_set_of_samples_alone(cloud: RawCloud, random: Any) -> None:
    order = list(range(len(cloud)))
    random.shuffle(order)
    assert encode(cloud) == encode(cloud.take(np.array(order))) == encode(cloud, engine="numpy")


@settings(max_examples=40)
@given(raw_clouds(most=60))
def test_a_reader_written_from_the_specification_agrees(cloud: RawCloud) -> None:
    frame = encode(cloud)
    decoded = decode_cloud(frame, samples=len(cloud), schema=cloud.schema)
    told = read_cloud(frame, len(cloud), [attribute.to_json() for attribute in cloud.schema])
    assert decoded.lattice().tolist() == [list(point) for point in told.pop("lattice")]
    assert decoded.codes.keys() == told.keys()
    for name, values in told.items():
        assert (
            decoded.codes[name].reshape(len(cloud), -1).tolist()
            == np.reshape(np.array(values, object), (len(cloud), -1)).tolist()
        )


@settings(max_examples=40)
@given(raw_clouds(), st.integers(0, 64))
def test_any_window_decodes(cloud: RawCloud, window: int) -> None:
    channels = channels_of(cloud.schema)
    rows = to_channels(cloud.codes, cloud.schema, len(cloud))
    packed = [
        engine.pack(engine.arrange(cloud.lattice, rows, 0, len(cloud)), cloud.lattice, rows, channels, window, None)
        for engine in (codec_compiled, codec_numpy)
    ]
    payloads = [pack_header(p) + p.raw.tobytes() + p.tokens.tobytes() for p in packed]
    assert payloads[0] == payloads[1]
    layout = parse_layout(payloads[0], samples=len(cloud), channels=channels)
    first, second = (engine.decode(payloads[0], layout, channels) for engine in (codec_compiled, codec_numpy))
    np.testing.assert_array_equal(first.rows, second.rows)
    np.testing.assert_array_equal(first.position, second.position)


@settings(max_examples=20)
@given(raw_clouds())
def test_a_batch_is_its_clouds_one_by_one(cloud: RawCloud) -> None:
    cuts = sorted({0, len(cloud) // 3, len(cloud) // 2, len(cloud)})
    frames = encode_clouds(cloud.lattice, cloud.codes, np.array(cuts), cloud.schema)
    parts = [cloud.take(np.arange(first, stop)) for first, stop in itertools.pairwise(cuts)]
    assert frames == [encode(part) for part in parts]


@pytest.mark.parametrize("effort", ["default", "best", "fast"])
def test_every_effort_is_lossless(effort: codec.Effort) -> None:
    rng = np.random.default_rng(1)
    lattice = rng.integers(0, 500, (2000, 3))
    codes = {attribute.name: random_codes(rng, attribute, 2000, True) for attribute in ATTRIBUTES}
    frame = encode_cloud(lattice, codes, ATTRIBUTES, effort=effort)
    decoded = decode_cloud(frame, samples=2000, schema=ATTRIBUTES)
    assert rows(decoded.lattice(), dict(decoded.codes)) == rows(lattice, codes)


def grid(*shape: int) -> Any:
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(
    ("lattice", "most_bytes"),
    [
        pytest.param(np.array([[7, -7, 2**40]]), 50, id="one sample"),
        pytest.param(np.tile([[1, 2, 3]], (2048, 1)), 80, id="coincident"),
        pytest.param(grid(16, 16, 8), 300, id="grid"),
        pytest.param(grid(2048, 1, 1), 2200, id="line"),
        pytest.param(grid(45, 45, 1), 1500, id="plane"),
        pytest.param(np.array([[0, 0, 0], [2**48 - 1, 0, 5]]), 90, id="widest"),
        pytest.param(np.array([[-(2**52) + 1] * 3, [-(2**52) + 9] * 3]), 60, id="furthest"),
        pytest.param(np.repeat(grid(9, 9, 9), 100, axis=0), 10_000, id="more than 65536"),
    ],
)
def test_odd_shapes(lattice: Any, most_bytes: int) -> None:
    normals = encode_normals(np.tile([[0.6, 0.0, -0.8]], (len(lattice), 1)))
    frame = encode_cloud(lattice, {"normal": normals}, (NORMAL,))
    assert len(frame) <= most_bytes
    for engine in ("compiled", "numpy"):
        cloud = decode_cloud(frame, samples=len(lattice), schema=(NORMAL,), engine=engine)
        assert rows(cloud.lattice(), dict(cloud.codes)) == rows(lattice, {"normal": normals})


def test_a_wide_cloud_keeps_its_low_bits_apart() -> None:
    lattice = np.array([[0, 0, 0], [2**20 - 1, 3, 2**19]])
    cloud = decode_cloud(encode_cloud(lattice, {}, ()), samples=2, schema=())
    assert cloud.shift == 4
    assert cloud.low is not None
    assert sorted(cloud.low.tolist()) == [[0, 0, 0], [15, 3, 0]]
    assert sorted(cloud.lattice().tolist()) == lattice.tolist()


def test_samples_come_in_morton_order() -> None:
    lattice = np.random.default_rng(3).integers(0, 64, (500, 3))
    position = decode_cloud(encode_cloud(lattice, {}, ()), samples=500, schema=()).position.astype(int)

    def code(point: Any, axes: Any) -> int:
        return sum(
            (int(point[axis]) >> bit & 1) << (3 * bit + slot) for bit in range(6) for slot, axis in enumerate(axes)
        )

    sides = [np.where(flips, 63 - position, position) for flips in itertools.product((False, True), repeat=3)]
    orders = [[code(point, np.roll([0, 1, 2], -turn)) for point in side] for side in sides for turn in range(3)]
    assert any(order == sorted(order) for order in orders)


@pytest.mark.parametrize(
    ("lattice", "codes"),
    [
        pytest.param(np.empty((0, 3), np.int64), np.empty((0, 2), np.uint8), id="empty"),
        pytest.param(np.array([[0, 0, 0], [2**48, 0, 0]]), np.full((2, 2), 127, np.uint8), id="too wide"),
        pytest.param(np.array([[2**52, 0, 0]]), np.full((1, 2), 127, np.uint8), id="too far"),
        pytest.param(np.zeros((2, 3), np.int64), np.full((1, 2), 127, np.uint8), id="a code too few"),
        pytest.param(np.zeros((1, 3), np.int64), np.full((1, 2), 255, np.uint8), id="a code too large"),
    ],
)
@pytest.mark.parametrize("engine", ["compiled", "numpy"])
def test_what_no_cloud_can_be_is_refused(lattice: Any, codes: Any, engine: codec.Engine) -> None:
    with pytest.raises(ValueError, match=r"cloud|lattice|code"):
        encode_cloud(lattice, {"normal": codes}, (NORMAL,), engine=engine)


def test_a_missing_attribute_is_refused() -> None:
    with pytest.raises(ValueError, match="normal"):
        encode_cloud(np.zeros((1, 3), np.int64), {}, (NORMAL,))


def test_normals_of_two_codes_come_back_as_their_canonical_twin() -> None:
    codes = np.array([[0, 3], [254, 100], [9, 0], [254, 0]], np.uint8)  # all on the border
    lattice = np.arange(12).reshape(4, 3)
    cloud = decode_cloud(encode_cloud(lattice, {"normal": codes}, (NORMAL,)), samples=4, schema=(NORMAL,))
    where = np.lexsort(cloud.lattice().T)
    np.testing.assert_array_equal(decode_normals(cloud.codes["normal"][where]), decode_normals(codes))


def test_without_numba_numpy_decodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "find_spec", lambda _: None)
    assert codec._codec.__wrapped__("auto") is codec_numpy
    with pytest.raises(ValueError, match="engine"):
        codec._codec.__wrapped__("fortran")


def test_points_of_a_cloud_carry_every_attribute(header: Any) -> None:
    schema = (
        NORMAL,
        Attribute(name="color", kind="color", dtype="<u2", bits=8, scale=257),
        Attribute(name="intensity", kind="scalar", dtype="<i2", bits=4, offset=-5, scale=10),
    )
    cloud = Cloud(
        origin=np.array([10, 20, 30]),
        position=np.array([[0, 0, 0], [1, 2, 3]], np.uint16),
        codes={
            "normal": np.array([[127, 127], [0, 0]], np.uint8),
            "color": np.array([[0, 1, 255], [2, 3, 4]], np.uint8),
            "intensity": np.array([0, 15], np.uint8),
        },
    )
    points = cloud_to_points(cloud, header(schema, {"classification": Constant("<u1", 2)}))
    np.testing.assert_allclose(points.xyz, [[105.0, 210.0, 315.0], [105.5, 211.0, 316.5]])
    assert points.normal is not None
    np.testing.assert_array_equal(points.normal, [[0, 0, 1], [0, 0, 0]])
    np.testing.assert_array_equal(points.attributes["color"], [[0, 257, 65535], [514, 771, 1028]])
    np.testing.assert_array_equal(points.attributes["intensity"], [-5, 145])
    assert points.attributes["intensity"].dtype == "<i2"
    np.testing.assert_array_equal(points.attributes["classification"], [2, 2])


@pytest.fixture
def header() -> Any:
    def make(schema: Any, constants: Any) -> Any:
        return SimpleNamespace(origin=(100.0, 200.0, 300.0), step=0.5, attributes=schema, constants=constants)

    return make
