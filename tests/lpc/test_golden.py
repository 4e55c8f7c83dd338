"""A file that an earlier program wrote is read to the same samples: what docs/format.md promises of a version."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from oracles.cloud import read_cloud
from support.frames import decoded_clouds, whole_index

from lpc.payload import CODEC

DATA = (Path(__file__).parents[1] / "data" / f"version{CODEC}.lpc").read_bytes()
SAMPLES = "a4cdc8d68e386c5798fe368e43fcacff"
"""Of all lattice points with their codes, cloud by cloud in the order of the file, as text."""


def digest(rows: list[list[int]]) -> str:
    return hashlib.blake2b(repr(rows).encode(), digest_size=16).hexdigest()


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_both_engines_read_what_was_written(engine: Literal["numpy", "compiled"]) -> None:
    rows: list[list[int]] = []
    for cloud in decoded_clouds(DATA, engine):
        values = [codes.reshape(len(cloud), -1).astype(np.int64) for codes in cloud.codes.values()]
        rows += np.concatenate([cloud.lattice(), *values], axis=1).tolist()
    assert digest(rows) == SAMPLES


def test_so_does_a_reader_written_from_the_specification() -> None:
    index, rows = whole_index(DATA), []
    entries = [attribute.to_json() for attribute in index.header.attributes]
    assert len(index) > 8
    assert index.header.levels > 5  # there are clouds whose root is too far above to tell them
    found: list[dict[str, list[object]]] = []
    for node in range(len(index)):
        place, line = index.cloud_range(node), [node]
        while index.parent[line[-1]] >= 0:
            line.append(int(index.parent[line[-1]]))
        ancestors = [found[above] for above in line[:0:-1]]
        found.append(read_cloud(DATA[place.start : place.stop], int(index.samples[node]), entries, ancestors))
        columns = [found[-1][name] for name in ("lattice", *(entry["name"] for entry in entries))]
        rows += [[number for part in row for number in np.ravel(part).tolist()] for row in zip(*columns, strict=True)]
    assert digest(rows) == SAMPLES
