"""Hypothesis strategies for what passes between rooms."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

from lpc.attributes import Attribute
from lpc.constants import Constant
from lpc.header import Header, seal
from lpc.page import NO_CONE, RECORD, child_counts, pack_pages
from lpc.ranges import ByteRange

if TYPE_CHECKING:
    from numpy.typing import NDArray

finite = st.floats(-1e6, 1e6, allow_nan=False)
lengths = st.floats(1e-6, 1e6, allow_nan=False)
names = st.text(
    st.characters(min_codepoint=33, max_codepoint=0x2FFF, exclude_categories=["Cs"]), min_size=1, max_size=12
)

ATTRIBUTES = (
    Attribute(name="normal", kind="normal", dtype="<f4", bits=8),
    Attribute(name="color", kind="color", dtype="<u2", bits=8, scale=257),
    Attribute(name="intensity", kind="scalar", dtype="<u2", bits=16),
    Attribute(name="time", kind="scalar", dtype="<f8", bits=64),
)


@st.composite
def headers(draw: st.DrawFn) -> Header:
    """Any header that a file may have."""
    nodes = draw(st.integers(1, 10**6))
    origin = tuple(draw(finite) for _ in range(3))
    side = draw(lengths)
    shares = [sorted((draw(st.floats(0, 1)), draw(st.floats(0, 1)))) for _ in range(3)]
    low = [origin[axis] + side * shares[axis][0] for axis in range(3)]
    high = [origin[axis] + side * shares[axis][1] for axis in range(3)]
    return Header(
        digest=draw(st.text("0123456789abcdef", min_size=32, max_size=32)),
        bytes=draw(st.integers(2**33, 2**53)),
        samples=draw(st.integers(nodes, 2**53)),
        nodes=nodes,
        levels=draw(st.integers(1, min(nodes, 256))),
        cloud_size=draw(st.integers(1, 2**20)),
        page_nodes=draw(st.integers(1, 4096)),
        origin=(origin[0], origin[1], origin[2]),
        step=draw(lengths),
        side=side,
        bounds=(low[0], low[1], low[2], high[0], high[1], high[2]),
        spacing=draw(lengths),
        position_error=draw(lengths),
        attributes=tuple(draw(st.lists(st.sampled_from(ATTRIBUTES), unique=True))),
        constants=draw(
            st.just({}) | st.just({"classification": Constant("<u1", 2), "tint": Constant("<f4", (0.5, 1.0))})
        ),
        crs=draw(st.none() | st.text(max_size=50)),
        left_out=draw(st.dictionaries(names, st.text(max_size=20), max_size=3)),
        rejected=draw(st.dictionaries(names, st.integers(0, 10**9), max_size=3)),
        seed=draw(st.integers(0, 2**64 - 1)),
        generator=draw(st.text(max_size=20)),
    )


@dataclass(frozen=True, slots=True)
class FakeModel:
    """A file whose index is true and whose clouds are noise."""

    header: Header
    records: NDArray[Any]
    data: bytes
    pages: list[tuple[int, bytes]]


def random_records(shape: list[int], rng: np.random.Generator) -> NDArray[Any]:
    """Records of the breadth-first tree whose nodes have the children bits `shape`; nodes beyond it are leaves."""
    bits: list[int] = []
    count = 1
    for number in itertools.count():
        if number >= count:
            break
        bits.append(shape[number] if number < len(shape) else 0)
        count += bits[-1].bit_count()
    records = np.zeros(count, RECORD)
    records["children"] = bits
    records["center"] = rng.integers(0, 2**32, (count, 3))
    records["radius"] = rng.uniform(7, 10, count)  # all meet in the box of `fake_model`
    records["spacing"] = rng.uniform(0.01, 1, count)
    records["samples"] = rng.integers(1, 65, count)
    records["size"] = rng.integers(16, 60, count)
    records["crc"] = rng.integers(0, 2**32, count)
    records["cone_axis"] = rng.integers(1, 255, (count, 2))
    records["cone_angle"] = rng.choice([NO_CONE, 0, 65534, 1234], count)
    first = 1 + np.concatenate([[0], np.cumsum(child_counts(records))])
    for node in reversed(range(count)):
        below = records["subtree"][first[node] : first[node + 1]].sum()
        records["subtree"][node] = records["samples"][node] + below
    return records


def levels_of(records: NDArray[Any]) -> list[int]:
    """Level of each node."""
    levels = [0]
    for node, bits in enumerate(records["children"]):
        levels += [levels[node] + 1] * int(bits).bit_count()
    return levels


def fake_model(records: NDArray[Any], page_nodes: int, rng: np.random.Generator) -> FakeModel:
    """The file of some records."""
    header = Header(
        bytes=2**40,
        samples=int(records["subtree"][0]),
        nodes=len(records),
        levels=max(levels_of(records)) + 1,
        cloud_size=64,
        page_nodes=page_nodes,
        origin=(10.0, -20.0, 30.0),
        step=0.01,
        side=8.0,
        bounds=(10.0, -20.0, 30.0, 18.0, -12.0, 38.0),
        spacing=0.05,
        position_error=0.01,
    )
    header = seal(header, records)
    pages = list(pack_pages(header.tag, records, page_nodes, header.page0))
    parts = [header.to_bytes()]
    for number, (_, page) in enumerate(pages):
        own = records["size"][number * page_nodes : (number + 1) * page_nodes]
        parts += [page, rng.bytes(int(own.sum()))]
    return FakeModel(header, records, b"".join(parts), pages)


@st.composite
def fake_models(draw: st.DrawFn, max_nodes: int = 120) -> FakeModel:
    """Trees of every shape: chains, full trees, long runs of leaves; pages from one record to the whole index."""
    shape = draw(st.lists(st.sampled_from([0, 1, 2, 3, 3]), max_size=max_nodes // 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return fake_model(random_records(shape, rng), draw(st.integers(1, 20)), rng)


@st.composite
def byte_ranges(draw: st.DrawFn, top: int = 1000) -> ByteRange:
    """Ranges below `top`, crowded enough to touch and overlap."""
    start = draw(st.integers(0, top - 1))
    return ByteRange(start, draw(st.integers(start + 1, min(top, start + 100))))
