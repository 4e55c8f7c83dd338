"""What the header says that a sample costs is what the file costs, the header itself included."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces
from oracles.build import build_bytes
from support.built import build_points

from lpc.header import parse_header
from lpc.points import PointBatch

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.header import Header


def check(header: Header, length: int) -> None:
    bits = header.bits_per_sample
    assert header.bytes == length
    assert bits["total"] == 8 * length / header.samples


@pytest.mark.parametrize("n", [1, 7, 500, 5000])
def test_the_total_is_the_whole_file_and_the_parts_add_up(n: int, tmp_path: Path) -> None:
    built = build_points(surfaces.sphere(n, seed=n), tmp_path / "m.lpc", cloud_size=300)
    check(built.header, len(built.data))
    bits = dict(built.header.bits_per_sample)
    total = bits.pop("total")
    assert sum(bits.values()) == pytest.approx(total, abs=1e-8)
    by_name = built.header.attribute_bits
    assert by_name.keys() == {attribute.name for attribute in built.header.attributes}
    assert sum(by_name.values()) == pytest.approx(bits["normal"] + bits["color"] + bits["other"], abs=1e-8)
    outside = len(built.data) - int(built.index.size.sum())
    assert bits["index"] == pytest.approx(8 * outside / n, abs=0.01)


@pytest.mark.parametrize("n", range(4985, 5015))
def test_a_length_is_found_that_states_itself(n: int, tmp_path: Path) -> None:
    """Among so many sizes are some where the digits of the total lengthen the header and so change the total."""
    xyz = np.arange(n)[:, None] * np.array([0.1, 0.0, 0.0])
    built = build_points(PointBatch(xyz), tmp_path / "m.lpc", cloud_size=1024)
    check(built.header, len(built.data))


def test_the_oracle_agrees_on_what_is_counted() -> None:
    for n in (1, 100, 3000):
        data = build_bytes(surfaces.sphere(n, seed=n), cloud_size=128)
        check(parse_header(data), len(data))
