"""Compiled loops of the readers: where rows of varying length begin, area vectors of polygons, and LZF."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def walk_bytes(
    data: NDArray[np.uint8],
    sizes: NDArray[np.int64],
    count_sizes: NDArray[np.int64],
    big_endian: bool,
    rows: int,
    at: NDArray[np.int64],
) -> int:
    """Find where the properties of binary PLY rows stand.

    Parameters
    ----------
    data : ndarray of uint8
        Rows one after another, the last one perhaps cut.
    sizes, count_sizes : ndarray, (p,) int64
        Bytes of a value, and of the count before a list (0: a single value), by property.
    big_endian : bool
        Byte order of the counts.
    rows : int
        Most rows to find.
    at : ndarray, (rows, p + 1) int64
        Out: first byte of each property, and the end of the row.

    Returns
    -------
    int
        Rows that are whole; -1 - row if a list declares a negative count (top bit set).
    """
    position = 0
    properties = len(sizes)
    for row in range(rows):
        for prop in range(properties):
            at[row, prop] = position
            width = count_sizes[prop]
            if width == 0:
                position += sizes[prop]
            else:
                if position + width > len(data):
                    return row
                count = 0
                for byte in range(width):
                    here = position + (byte if big_endian else width - 1 - byte)
                    count = (count << 8) | data[here]
                if width == 4 and count >= 1 << 31:
                    return -1 - row
                position += width + count * sizes[prop]
            if position > len(data):
                return row
        at[row, properties] = position
    return rows


@numba.njit(cache=True, nogil=True)
def walk_words(words: NDArray[np.float64], is_list: NDArray[np.bool_], rows: int, at: NDArray[np.int64]) -> int:
    """Find where the properties of ascii PLY rows stand: `walk_bytes` with words for bytes."""
    position = 0
    properties = len(is_list)
    for row in range(rows):
        for prop in range(properties):
            at[row, prop] = position
            if position >= len(words):
                return row
            if is_list[prop]:
                count = words[position]
                if not (0 <= count < 2147483648.0):
                    return -1 - row
                position += int(count)
            position += 1
            if position > len(words):
                return row
        at[row, properties] = position
    return rows


@numba.njit(cache=True, nogil=True)
def add_polygons(
    xyz: NDArray[np.float32], counts: NDArray[np.int64], corners: NDArray[np.int64], sums: NDArray[np.float32]
) -> None:
    """Add the area vector of each polygon to the sums at its corners, unless a corner is not finite.

    Parameters
    ----------
    xyz, sums : ndarray, (n, 3) float32
        Vertices; their sums, changed here.
    counts, corners : ndarray of int64
        Corners of each polygon, and their vertices one after another, all within `xyz`.
    """
    start = 0
    for count in counts:
        ax = ay = az = 0.0
        o = corners[start] if count else 0
        for k in range(1, count - 1):
            p, q = corners[start + k], corners[start + k + 1]
            px, py, pz = np.float64(xyz[p, 0]), np.float64(xyz[p, 1]), np.float64(xyz[p, 2])
            qx, qy, qz = np.float64(xyz[q, 0]), np.float64(xyz[q, 1]), np.float64(xyz[q, 2])
            px, py, pz = px - xyz[o, 0], py - xyz[o, 1], pz - xyz[o, 2]
            qx, qy, qz = qx - xyz[o, 0], qy - xyz[o, 1], qz - xyz[o, 2]
            ax += py * qz - pz * qy
            ay += pz * qx - px * qz
            az += px * qy - py * qx
        if np.isfinite(ax + ay + az):
            for k in range(count):
                corner = corners[start + k]
                sums[corner, 0] += ax
                sums[corner, 1] += ay
                sums[corner, 2] += az
        start += count


@numba.njit(cache=True, nogil=True)
def lzf_decompress(source: NDArray[np.uint8], target: NDArray[np.uint8], state: NDArray[np.int64]) -> int:
    """Decode LZF (Marc Lehmann's format, as PCD uses it) piece by piece.

    Parameters
    ----------
    source : ndarray of uint8
        Compressed bytes from the next control byte on, the last item perhaps cut.
    target : ndarray of uint8
        What was decoded so far in ``target[:state[1]]``, at least the last 8 KiB of it; grows here.
    state : ndarray, (2,) int64
        Bytes of `source` used, and bytes of `target` filled; changed here.

    Returns
    -------
    int
        0 when it stopped for lack of source or of room, -1 when the bytes are no LZF.
    """
    i, o = state[0], state[1]
    result = 0
    while i < len(source):
        control = np.int64(source[i])
        if control < 32:
            run = control + 1
            if i + 1 + run > len(source) or o + run > len(target):
                break
            target[o : o + run] = source[i + 1 : i + 1 + run]
            i += 1 + run
            o += run
            continue
        used = 3 if control >> 5 == 7 else 2
        if i + used > len(source):
            break
        run = (control >> 5) + 2 if used == 2 else np.int64(source[i + 1]) + 9
        back = ((control & 31) << 8) + np.int64(source[i + used - 1]) + 1
        if back > o:
            result = -1
            break
        if o + run > len(target):
            break
        for k in range(run):  # byte by byte: source and target of a copy may overlap
            target[o + k] = target[o + k - back]
        i += used
        o += run
    state[0], state[1] = i, o
    return result


def gather(data: NDArray[Any], starts: NDArray[np.int64], width: int) -> NDArray[Any]:
    """``data[start : start + width]`` for all starts, (n, width)."""
    return data[starts[:, None] + np.arange(width)]
