"""Files that fill up: the map says what is there, whatever happened to it."""

from __future__ import annotations

import os
import random
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.ranges import ByteRange
from pointstream.stores.presence import Presence
from pointstream.stores.sparse import HEAD, RECORD, SparseFile, map_path

if TYPE_CHECKING:
    from pathlib import Path

LENGTH = 60
TAG = b"build id"
DATA = random.Random(3).randbytes(LENGTH)

places = st.tuples(st.integers(0, LENGTH - 1), st.integers(1, 20)).map(
    lambda pair: ByteRange(pair[0], min(LENGTH, pair[0] + pair[1]))
)
steps = st.lists(st.tuples(st.booleans(), places), max_size=25)


def bytes_of(place: ByteRange) -> set[int]:
    return set(range(place.start, place.stop))


@given(steps, st.lists(places, min_size=1))
def test_presence_is_a_set_of_bytes(changes: list[tuple[bool, ByteRange]], asked: list[ByteRange]) -> None:
    presence, right = Presence(), set()
    for here, place in changes:
        (presence.add if here else presence.remove)(place)
        right = right | bytes_of(place) if here else right - bytes_of(place)
        assert presence.total == len(right)
    assert set().union(*map(bytes_of, presence)) == right
    stops = [place.stop for place in presence]
    assert all(stop < place.start for stop, place in zip(stops, list(presence)[1:], strict=False)), "not merged"
    here = presence.holds(np.array([place.start for place in asked]), np.array([place.stop for place in asked]))
    for place, held in zip(asked, here.tolist(), strict=True):
        gaps = presence.missing(place)
        assert set().union(*map(bytes_of, gaps)) == bytes_of(place) - right
        assert held == (bytes_of(place) <= right) == (place in presence)


def opened(folder: Path, tag: bytes = TAG, **options: bool) -> SparseFile:
    return SparseFile(folder / "file", length=LENGTH, tag=tag, **options)


def keep(file: SparseFile, start: int, stop: int) -> None:
    file.keep(ByteRange(start, stop), DATA[start:stop])


def test_what_was_kept_is_there_in_the_next_session(tmp_path: Path) -> None:
    first = opened(tmp_path)
    keep(first, 10, 20)
    keep(first, 40, 50)
    first.drop(ByteRange(12, 14))
    first.close()
    again = opened(tmp_path, writable=False)
    assert [(place.start, place.stop) for place in again.present] == [(10, 12), (14, 20), (40, 50)]
    assert again.read(ByteRange(40, 50)) == DATA[40:50]
    assert (tmp_path / "file").stat().st_size == LENGTH
    again.close()


def test_a_full_file_is_simply_the_file_until_something_in_it_proves_damaged(tmp_path: Path) -> None:
    file = opened(tmp_path)
    for start in (30, 0, 45, 15):
        keep(file, start, start + 15)
    file.close()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_bytes() == DATA
    again = opened(tmp_path)
    assert again.complete
    again.drop(ByteRange(7, 9))
    again.close()
    once_more = opened(tmp_path)
    assert once_more.missing(ByteRange(0, LENGTH)) == [ByteRange(7, 9)]
    keep(once_more, 7, 9)
    once_more.close()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("torn", range(1, RECORD.size))
def test_a_torn_record_is_cut_off_and_spoils_nothing_after_it(torn: int, tmp_path: Path) -> None:
    file = opened(tmp_path)
    keep(file, 0, 10)
    file.flush()
    keep(file, 30, 40)
    file.close()
    place = map_path(tmp_path / "file")
    os.truncate(place, place.stat().st_size - torn)
    again = opened(tmp_path)
    assert list(again.present) == [ByteRange(0, 10)]
    keep(again, 50, 60)
    again.close()
    once_more = opened(tmp_path)
    assert list(once_more.present) == [ByteRange(0, 10), ByteRange(50, 60)]
    once_more.close()


@given(st.binary(max_size=200), st.booleans())
def test_any_map_is_read_or_replaced(tmp_path_factory: pytest.TempPathFactory, text: bytes, headed: bool) -> None:
    folder = tmp_path_factory.mktemp("map")
    (folder / "file").write_bytes(bytes(LENGTH))
    map_path(folder / "file").write_bytes((HEAD.pack(b"LPCMAP\x01\n", LENGTH, TAG) if headed else b"") + text)
    file = opened(folder)
    assert file.present.total == 0
    keep(file, 3, 9)
    file.close()
    again = opened(folder)
    assert list(again.present) == [ByteRange(3, 9)]
    again.close()


def test_the_map_of_another_build_counts_for_nothing(tmp_path: Path) -> None:
    file = opened(tmp_path)
    keep(file, 0, 10)
    file.close()
    other = opened(tmp_path, tag=b"other id")
    assert len(other.present) == 0
    other.close()


def test_two_writers_of_one_file_leave_what_both_wrote(tmp_path: Path) -> None:
    one, other = opened(tmp_path), opened(tmp_path)
    for start in range(0, 50, 10):
        keep(one if start % 20 else other, start, start + 10)
        (one if start % 20 else other).flush()
    one.close()
    other.close()
    again = opened(tmp_path)
    assert list(again.present) == [ByteRange(0, 50)]
    assert again.read(ByteRange(0, 50)) == DATA[:50]
    again.close()


def test_a_map_grown_long_is_written_anew(tmp_path: Path) -> None:
    file = opened(tmp_path)
    for _ in range(1500):
        keep(file, 0, 10)
        file.drop(ByteRange(0, 10))
    keep(file, 0, 10)
    file.close()
    long = map_path(tmp_path / "file").stat().st_size
    opened(tmp_path).close()
    assert map_path(tmp_path / "file").stat().st_size == HEAD.size + RECORD.size < long
