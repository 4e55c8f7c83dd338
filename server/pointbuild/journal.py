"""What a build has finished, entry by entry, so that one that was killed goes on from there.

A journal is a file of entries, each a few arrays, packed with zstd, behind their length and CRC-32. An entry is added
when what it tells of is in its file; a torn entry at the end, and all after it, was never there.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

_LEVEL = 1  # counts of cells are nearly all zeros
_LENGTH = struct.Struct("<H")
_HEAD = struct.Struct("<QII")  # bytes of the body, its CRC-32, arrays in it


class Journal:
    """A file of entries.

    Parameters
    ----------
    path : Path
        What stands there is recalled.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.entries = 0
        self._end = 0
        for _, end in self._bodies():
            self.entries += 1
            self._end = end
        if path.exists():
            os.truncate(path, self._end)

    def add(self, *arrays: NDArray[Any]) -> None:
        """Append an entry."""
        data = zstandard.compress(b"".join(part for array in arrays for part in _packed(np.asarray(array))), _LEVEL)
        with self._path.open("ab") as file:
            file.write(_HEAD.pack(len(data), zlib.crc32(data), len(arrays)) + data)
        self.entries += 1

    def __iter__(self) -> Iterator[list[NDArray[Any]]]:
        for (count, data), _ in self._bodies():
            body = zstandard.decompress(data)
            arrays, at = [], 0
            for _ in range(count):
                array, at = _unpacked(body, at)
                arrays.append(array)
            yield arrays

    def _bodies(self) -> Iterator[tuple[tuple[int, bytes], int]]:
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            room = os.fstat(file.fileno()).st_size
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                length, check, count = _HEAD.unpack(head)
                if length > room:
                    return
                data = file.read(length)
                if len(data) < length or zlib.crc32(data) != check:
                    return
                yield (count, data), file.tell()


def _packed(array: NDArray[Any]) -> tuple[bytes, bytes]:
    """Type and shape, then the values; numpy's own format takes longer over a header than a run of nodes has time."""
    head = f"{array.dtype.str} {' '.join(map(str, array.shape))}".encode()
    return _LENGTH.pack(len(head)) + head, array.tobytes()


def _unpacked(body: bytes, at: int) -> tuple[NDArray[Any], int]:
    """Inverse of `_packed`: the array at a place, and the place after it."""
    begin = at + _LENGTH.size
    end = begin + _LENGTH.unpack_from(body, at)[0]
    kind, *shape = body[begin:end].decode().split()
    sides = tuple(map(int, shape))
    array = np.frombuffer(body, kind, math.prod(sides), end).reshape(sides)
    return array.copy(), end + array.nbytes


def as_array(values: Any) -> NDArray[np.uint8]:
    """Plain values as an array for `Journal.add`: their JSON text."""
    return np.frombuffer(json.dumps(values).encode(), np.uint8)


def from_array(array: NDArray[np.uint8]) -> Any:
    """Inverse of `as_array`."""
    return json.loads(array.tobytes())
