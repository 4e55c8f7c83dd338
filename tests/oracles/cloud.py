"""A reader of one cloud, written from docs/format.md alone: plain Python integers, one sample after another."""

from __future__ import annotations

from typing import Any

import zstandard

Samples = dict[str, list[Any]]


class Bits:
    """A bit stream, least significant bit first."""

    def __init__(self, data: bytes) -> None:
        self.number = int.from_bytes(data, "little")
        self.at = 0

    def take(self, width: int) -> int:
        value = self.number >> self.at & ((1 << width) - 1)
        self.at += width
        return value

    @property
    def bytes_read(self) -> int:
        return (self.at + 7) // 8


def read_cloud(frame: bytes, samples: int, attributes: list[dict[str, Any]]) -> Samples:
    """Lattice coordinates under "lattice", codes by attribute name.

    Parameters
    ----------
    attributes : list of dict
        The header's entries: `name`, `kind`, `bits`.
    """
    payload = zstandard.ZstdDecompressor().decompress(frame)
    assert payload[0] == 1
    rotation, nbits, shift, window, turn, corner_bytes = payload[1:7]
    at = 8
    corner = []
    for _ in range(3):
        corner.append(int.from_bytes(payload[at : at + corner_bytes], "little", signed=True))
        at += corner_bytes

    channels: list[tuple[int, int]] = []  # levels, start
    for entry in attributes:
        bits = entry["bits"]
        if entry["kind"] == "normal":
            channels += [(1 << bits, (1 << (bits - 1)) - 1)] * 2
        elif entry["kind"] == "color":
            channels += [(1 << bits, 0), (2 << bits, 0), (2 << bits, 0)]
        else:
            channels += [(1 << (bits - 32), 0), (1 << 32, 0)] if bits > 32 else [(1 << bits, 0)]
    tokens = payload[len(payload) - samples * (1 + len(channels)) :]

    raw = Bits(payload[at:])
    low = [[raw.take(shift) for _ in range(3)] for _ in range(samples)]
    at += raw.bytes_read

    def numbers(stream: int) -> list[int]:
        nonlocal at
        raw = Bits(payload[at:])
        values = []
        for token in tokens[stream * samples : (stream + 1) * samples]:
            n = (token >> 1) - 1
            values.append(token if token < 2 else (2 | token & 1) << n | raw.take(n))
        at += raw.bytes_read
        return values

    code, top = 0, []
    for step in numbers(0):
        code += step
        point = [0, 0, 0]
        for i in range(nbits):
            for s in range(3):
                point[(rotation + s) % 3] |= (code >> (3 * i + s) & 1) << i
        top.append(point)
    before: list[int | None] = []
    for i in range(samples):
        near = [(sum(abs(top[i][a] - top[j][a]) for a in range(3)), i - j) for j in range(max(0, i - window), i)]
        before.append(i - min(near)[1] if near else None)
    rows = []
    for channel, (levels, start) in enumerate(channels):
        row: list[int] = []
        for v, j in zip(numbers(1 + channel), before, strict=True):
            residual = -((v + 1) >> 1) if v & 1 else v >> 1
            row.append(((start if j is None else row[j]) + residual) % levels)
        rows.append(row)
    assert at + len(tokens) == len(payload)

    out: Samples = {
        "lattice": [tuple(corner[a] + ((top[i][a] << shift) | low[i][a]) for a in range(3)) for i in range(samples)]
    }
    for entry in attributes:
        bits = entry["bits"]
        if entry["kind"] == "normal":
            first, second = rows.pop(0), rows.pop(0)
            out[entry["name"]] = [turned_back(a, b, bits, turn) for a, b in zip(first, second, strict=True)]
        elif entry["kind"] == "color":
            out[entry["name"]] = [rgb(*ycc, bits) for ycc in zip(rows.pop(0), rows.pop(0), rows.pop(0), strict=True)]
        elif bits > 32:
            out[entry["name"]] = [high << 32 | part for high, part in zip(rows.pop(0), rows.pop(0), strict=True)]
        else:
            out[entry["name"]] = rows.pop(0)
    return out


def sign(value: int) -> int:
    return -1 if value < 0 else 1


def turned_back(first: int, second: int, bits: int, turn: int) -> tuple[int, int]:
    """Undo the turn of one code pair."""
    if turn == 0 or first == second == 0:
        return first, second
    m = (1 << (bits - 1)) - 1
    x, y = first - m, second - m
    z = m - abs(x) - abs(y)
    if z < 0:
        x, y = (m - abs(y)) * sign(x), (m - abs(x)) * sign(y)
    q = turn >> 1
    p = [0, 0, 0]
    p[q], p[(q + 1) % 3], p[(q + 2) % 3] = x, y, -z if turn & 1 else z
    x, y, z = p
    if z < 0:
        x, y = (m - abs(y)) * sign(x), (m - abs(x)) * sign(y)
    return x + m, y + m


def rgb(y: int, co: int, cg: int, bits: int) -> tuple[int, int, int]:
    """YCoCg-R back to red, green, blue."""
    co, cg = (value - (2 << bits) if value >= 1 << bits else value for value in (co, cg))
    t = y - (cg >> 1)
    blue = t - (co >> 1)
    return blue + co, cg + t, blue
