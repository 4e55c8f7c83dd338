"""Normals predicted by planes through the samples themselves: on, exact everywhere, and worth it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.cloud import directions, read_cloud

from lpc import codec_compiled, codec_numpy, normals_compiled, normals_numpy
from lpc.attributes import Attribute
from lpc.channels import channels_of, to_channels
from lpc.codec import LIMITS, decode_cloud, encode_cloud
from lpc.errors import Corrupt
from lpc.octahedral import encode_normals
from lpc.payload import FIRST_GRID, LAST_GRID, MAX_GRID_SAMPLES, pack_header, parse_layout, table_bits

NORMAL = Attribute(name="normal", kind="normal", dtype="<f4", bits=8)
GRID_AT, WINDOW_AT = 7, 4


def payload_of(frame: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(frame)


def bumpy_sphere(samples: int, seed: int, radius: float = 60.0, bits: int = 8) -> tuple[Any, Any]:
    """Lattice coordinates and normal codes of a closed surface that bends."""
    rng = np.random.default_rng(seed)
    unit = rng.normal(size=(samples, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    bumps = 1.0 + 0.1 * np.sin(4.0 * unit).sum(axis=1)
    slope = 0.4 * np.cos(4.0 * unit)
    slope -= (slope * unit).sum(axis=1)[:, None] * unit
    normals = bumps[:, None] * unit - slope
    return np.rint(radius * bumps[:, None] * unit).astype(np.int64), encode_normals(normals, bits)


def both(lattice: Any, codes: Any, schema: Any = (NORMAL,), effort: Any = "default") -> bytes:
    """A frame, after both engines have made it and read it back."""
    frames = [encode_cloud(lattice, codes, schema, engine=engine, effort=effort) for engine in ("compiled", "numpy")]
    assert frames[0] == frames[1]
    clouds = [
        decode_cloud(frames[0], samples=len(lattice), schema=schema, engine=engine) for engine in ("compiled", "numpy")
    ]
    for name in codes:
        np.testing.assert_array_equal(clouds[0].codes[name], clouds[1].codes[name])
    found = np.column_stack([clouds[0].lattice(), clouds[0].codes["normal"]])
    wanted = np.column_stack([lattice, codes["normal"]])
    np.testing.assert_array_equal(found[np.lexsort(found.T)], wanted[np.lexsort(wanted.T)])
    return frames[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_surface_is_predicted_by_planes_and_a_reader_of_the_specification_agrees(seed: int) -> None:
    lattice, normals = bumpy_sphere(900, seed)
    frame = both(lattice, {"normal": normals}, effort="best")
    assert FIRST_GRID <= payload_of(frame)[GRID_AT] <= LAST_GRID
    told = read_cloud(frame, 900, [NORMAL.to_json()])
    cloud = decode_cloud(frame, samples=900, schema=(NORMAL,))
    assert cloud.lattice().tolist() == [list(point) for point in told["lattice"]]
    assert cloud.codes["normal"].tolist() == [list(pair) for pair in told["normal"]]


def test_planes_take_bits_off_a_surface_and_never_add_any_to_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    lattice, normals = bumpy_sphere(2048, 7)
    noise = encode_normals(np.random.default_rng(1).normal(size=(2048, 3)))
    with_planes = both(lattice, {"normal": normals}, effort="best")
    with_noise = both(lattice, {"normal": noise})
    monkeypatch.setattr(codec_compiled, "best_planes", lambda *_: (0, 0, 0, np.empty((2, 2048), np.uint32)))
    without = encode_cloud(lattice, {"normal": normals}, (NORMAL,), effort="best")
    assert payload_of(without)[GRID_AT] == 0
    assert 8 * (len(without) - len(with_planes)) / 2048 > 1.0
    assert payload_of(with_noise)[GRID_AT] == 0
    assert with_noise == encode_cloud(lattice, {"normal": noise}, (NORMAL,))


def test_default_tries_planes_where_a_cloud_is_hard_and_fast_never_does() -> None:
    easy, hard = bumpy_sphere(2048, 7, radius=40.0), bumpy_sphere(2048, 7, radius=400.0)
    grids = {}
    for name, (lattice, normals) in (("easy", easy), ("hard", hard)):
        for effort in ("default", "best", "fast"):
            frame = both(lattice, {"normal": normals}, effort=effort)
            grids[name, effort] = payload_of(frame)[GRID_AT] > 0
            if effort == "default" and name == "easy":
                assert 8 * len(frame) <= LIMITS["default"].hard * 2048
    assert {key for key, used in grids.items() if used} == {("easy", "best"), ("hard", "best"), ("hard", "default")}


def test_what_other_channels_take_makes_no_cloud_hard() -> None:
    schema = (NORMAL, Attribute(name="color", kind="color", dtype="|u1", bits=8))
    lattice, normals = bumpy_sphere(2048, 7, radius=40.0)
    colors = np.random.default_rng(5).integers(0, 256, (2048, 3), np.uint8)
    frame = both(lattice, {"normal": normals, "color": colors}, schema)
    assert 8 * len(frame) > LIMITS["default"].hard * 2048
    assert payload_of(frame)[GRID_AT] == 0


def test_planes_that_save_too_little_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    lattice, normals = bumpy_sphere(2048, 7, radius=400.0)
    monkeypatch.setitem(LIMITS, "default", replace(LIMITS["default"], gain=8.0))
    assert payload_of(encode_cloud(lattice, {"normal": normals}, (NORMAL,)))[GRID_AT] == 0


@pytest.mark.parametrize("bits", [2, 5, 12, 16])
def test_normals_of_any_width(bits: int) -> None:
    schema = (Attribute(name="normal", kind="normal", dtype="<f4", bits=bits),)
    lattice, normals = bumpy_sphere(500, 3, bits=bits)
    frame = both(lattice, {"normal": normals}, schema, effort="best")
    told = read_cloud(frame, 500, [schema[0].to_json()])
    found = decode_cloud(frame, samples=500, schema=schema).codes["normal"]
    assert found.tolist() == [list(pair) for pair in told["normal"]]


def test_two_normals_and_other_channels_beside_them() -> None:
    schema = (
        Attribute(name="color", kind="color", dtype="|u1", bits=8),
        NORMAL,
        Attribute(name="time", kind="scalar", dtype="<u8", bits=40),
        Attribute(name="inward", kind="normal", dtype="<f4", bits=10),
    )
    rng = np.random.default_rng(4)
    lattice, normals = bumpy_sphere(700, 4)
    _, inward = bumpy_sphere(700, 4, bits=10)
    codes = {
        "color": rng.integers(0, 256, (700, 3), np.uint8),
        "normal": normals,
        "time": rng.integers(0, 1 << 40, 700, np.uint64),
        "inward": inward,
    }
    frame = both(lattice, codes, schema, effort="best")
    payload = payload_of(frame)
    assert payload[GRID_AT] > 0
    assert payload[WINDOW_AT] == 64  # colours want more samples to choose from
    told = read_cloud(frame, 700, [attribute.to_json() for attribute in schema])
    cloud = decode_cloud(frame, samples=700, schema=schema)
    for name, values in cloud.codes.items():
        assert values.reshape(700, -1).tolist() == np.reshape(np.array(told[name], object), (700, -1)).tolist()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(FIRST_GRID, LAST_GRID), st.integers(0, 5), st.integers(0, 64), st.integers(1, 60),
    st.sampled_from([1, 3, 40, 2**16 - 1]), st.integers(0, 2**32),
)  # fmt: skip
def test_any_residuals_on_any_grid_decode_alike(
    grid: int, turn: int, window: int, samples: int, extent: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    lattice = rng.integers(0, extent + 1, (samples, 3))
    codes = rng.integers(0, 255, (samples, 2)).astype(np.uint8)
    channels = channels_of((NORMAL,))
    packed = codec_numpy.encode(
        lattice, to_channels({"normal": codes}, (NORMAL,), samples), 0, samples, channels, window
    )
    packed = packed._replace(grid=grid, turn=turn)  # residuals of something else: any will do
    payload = pack_header(packed) + packed.raw.tobytes() + packed.tokens.tobytes()
    layout = parse_layout(payload, samples=samples, channels=channels)
    first, second = (engine.decode(payload, layout, channels) for engine in (codec_compiled, codec_numpy))
    np.testing.assert_array_equal(first.rows, second.rows)
    if int(first.rows.max()) < 255:
        told = read_cloud(zstandard.ZstdCompressor().compress(payload), samples, [NORMAL.to_json()])
        if turn:
            codec_compiled.turn_back(first.rows, channels, turn)
        assert first.rows.T.tolist() == [list(pair) for pair in told["normal"]]


@pytest.mark.parametrize("samples", [2, 500, 20_000])
def test_planes_of_crowds_wrap_alike(samples: int) -> None:
    """Thousands of samples in one cell leave 64 bits behind."""
    position = np.random.default_rng(samples).integers(0, 3, (samples, 3)).astype(np.uint16)
    position[: samples // 2] += np.uint16(2**16 - 4)
    for grid in (FIRST_GRID, 30, LAST_GRID):
        compiled = np.empty((samples, 3), np.int64)
        normals_compiled._planes(position, grid, table_bits(samples), compiled)
        np.testing.assert_array_equal(normals_numpy._planes(position, grid).T, compiled)
        if samples <= 500:
            assert compiled.tolist() == directions(position.astype(int).tolist(), grid)


def test_the_plane_of_a_tilted_plane_is_that_plane() -> None:
    rng = np.random.default_rng(6)
    across = rng.integers(0, 120, (1500, 2))
    position = np.column_stack([across, (across @ (1, 2)) // 3]).astype(np.uint16)
    normal = normals_numpy._planes(position, 24).astype(float)
    normal /= np.linalg.norm(normal, axis=0)
    wanted = np.array([1.0, 2.0, -3.0]) / np.sqrt(14.0)
    assert np.median(np.abs(wanted @ normal)) > np.cos(np.radians(2.0))


@pytest.mark.parametrize("grid", [1, FIRST_GRID - 1, LAST_GRID + 1, 255])
def test_a_grid_out_of_range_is_corrupt(grid: int) -> None:
    lattice, normals = bumpy_sphere(300, 2)
    payload = bytearray(payload_of(encode_cloud(lattice, {"normal": normals}, (NORMAL,))))
    payload[GRID_AT] = grid
    with pytest.raises(Corrupt, match=f"grid {grid} of 300"):
        parse_layout(bytes(payload), samples=300, channels=channels_of((NORMAL,)))


@pytest.mark.parametrize(
    ("samples", "bits"), [(1, 2), (4, 2), (5, 3), (32, 3), (33, 4), (2048, 5), (2049, 6), (65536, 7)]
)
def test_tables_have_room(samples: int, bits: int) -> None:
    assert table_bits(samples) == bits


def test_a_cloud_too_large_for_planes_has_none() -> None:
    lattice, normals = bumpy_sphere(MAX_GRID_SAMPLES + 1, 8, radius=4000.0)
    frame = encode_cloud(lattice, {"normal": normals}, (NORMAL,), effort="best", engine="compiled")
    assert payload_of(frame)[GRID_AT] == 0
    found = decode_cloud(frame, samples=len(lattice), schema=(NORMAL,))
    key = np.column_stack([found.lattice(), found.codes["normal"]])
    wanted = np.column_stack([lattice, normals])
    np.testing.assert_array_equal(key[np.lexsort(key.T)], wanted[np.lexsort(wanted.T)])
