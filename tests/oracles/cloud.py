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
    axes, nbits, shift, window, turn, corner_bytes, grid = payload[1:8]
    rotation, flips = axes % 4, axes // 4
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
        top.append([2**nbits - 1 - c if flips >> axis & 1 else c for axis, c in enumerate(point)])
    before: list[int | None] = []
    for i in range(samples):
        near = [(sum(abs(top[i][a] - top[j][a]) for a in range(3)), i - j) for j in range(max(0, i - window), i)]
        before.append(i - min(near)[1] if near else None)
    residuals = [
        [-((v + 1) >> 1) if v & 1 else v >> 1 for v in numbers(1 + channel)] for channel in range(len(channels))
    ]
    assert at + len(tokens) == len(payload)
    rows = []
    for (levels, start), row_of in zip(channels, residuals, strict=True):
        row: list[int] = []
        for residual, j in zip(row_of, before, strict=True):
            row.append(((start if j is None else row[j]) + residual) % levels)
        rows.append(row)
    if grid:
        normals = directions(top, grid)
        first = 0
        for entry in attributes:
            if entry["kind"] == "normal":
                pairs = list(zip(residuals[first], residuals[first + 1], strict=True))
                codes = on_planes(normals, pairs, before, entry["bits"], turn)
                rows[first], rows[first + 1] = [pair[0] for pair in codes], [pair[1] for pair in codes]
            first += {"normal": 2, "color": 3}.get(entry["kind"], 2 if entry["bits"] > 32 else 1)

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


def wrapped(value: int) -> int:
    """Modulo 2**64, signed."""
    return (value + (1 << 63)) % (1 << 64) - (1 << 63)


def cut(values: list[int]) -> list[int]:
    length = max((~v if v < 0 else v).bit_length() for v in values)
    return [v >> max(0, length - 20) for v in values]


def directions(points: list[list[int]], grid: int) -> list[list[int]]:
    """Least axis of the samples around each."""
    axes = 0
    while 8**axes < 16 * len(points):
        axes += 1
    scaled = [[(p * 32 * (7 - (grid & 3))) >> (grid >> 2) for p in point] for point in points]
    corners = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]

    def share(u: list[int], corner: tuple[int, int, int]) -> tuple[tuple[int, ...], int]:
        key, weight = [], 1
        for value, step in zip(u, corner, strict=True):
            f = ((value & 31) + 2) >> 2
            weight *= f if step else 8 - f
            key.append(((value >> 5) + step) % 2**axes)
        return tuple(key), weight

    nodes: dict[tuple[int, ...], list[int]] = {}
    for u in scaled:
        x, y, z = u
        terms = [1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
        for corner in corners:
            key, weight = share(u, corner)
            sums = nodes.setdefault(key, [0] * 10)
            nodes[key] = [s + weight * term for s, term in zip(sums, terms, strict=True)]
    found = []
    for u in scaled:
        total = [0] * 10
        for corner in corners:
            key, weight = share(u, corner)
            total = [s + weight * v for s, v in zip(total, nodes[key], strict=True)]
        s, x, y, z = total[:4]
        xx, yy, zz, xy, xz, yz = cut([
            wrapped(s * moment - one * other)
            for moment, one, other in zip(total[4:], (x, y, z, x, x, y), (x, y, z, y, z, z), strict=True)
        ])  # fmt: skip
        a, b, c, d, e, f = cut([
            yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy,
            xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx,
        ])  # fmt: skip
        columns = [[a, d, e], [d, b, f], [e, f, c]]
        column = columns[[a, b, c].index(max(a, b, c))]
        found.append(cut([sum(p * q for p, q in zip(line, column, strict=True)) for line in columns]))
    return found


def on_planes(
    normals: list[list[int]], residuals: list[tuple[int, int]], before: list[int | None], bits: int, turn: int
) -> list[tuple[int, int]]:  # fmt: skip
    """Code pairs, still turned."""
    m = (1 << (bits - 1)) - 1
    small = [r if 5 * max(abs(r[0]), abs(r[1])) < 1 << bits else (0, 0) for r in residuals]
    codes: list[tuple[int, int]] = []
    for (x, y, z), residual, j in zip(normals, residuals, before, strict=True):
        n = max(1, abs(x) + abs(y) + abs(z))
        px = (2 * m * abs(x) + n) // (2 * n)
        py = min((2 * m * abs(y) + n) // (2 * n), m - px)
        p = [px * sign(x), py * sign(y), (m - px - py) * sign(z)]
        q = turn >> 1
        p = [p[q], p[(q + 1) % 3], p[(q + 2) % 3] * (-1 if turn & 1 else 1)]
        last = (0, 0, m) if j is None else unfolded(*codes[j], m)
        if sum(a * b for a, b in zip(p, last, strict=True)) < 0:
            p = [-a for a in p]
        guess = folded(*p, m)
        carry = [4, 4]
        if j is not None:
            further = before[j]
            second = (0, 0) if further is None else small[further]
            carry = [4 + 3 * a + b for a, b in zip(small[j], second, strict=True)]
        first, other = (
            (g + (c >> 3) + r) % (1 << bits) for g, c, r in zip(guess, carry, residual, strict=True)
        )  # fmt: skip
        codes.append((first, other))
    return codes


def unfolded(first: int, second: int, m: int) -> tuple[int, int, int]:
    """Integer point of a code pair."""
    x, y = first - m, second - m
    z = m - abs(x) - abs(y)
    if z < 0:
        x, y = (m - abs(y)) * sign(x), (m - abs(x)) * sign(y)
    return x, y, z


def folded(x: int, y: int, z: int, m: int) -> tuple[int, int]:
    """Code pair of an integer point."""
    if z < 0:
        x, y = (m - abs(y)) * sign(x), (m - abs(x)) * sign(y)
    return x + m, y + m


def sign(value: int) -> int:
    return -1 if value < 0 else 1


def turned_back(first: int, second: int, bits: int, turn: int) -> tuple[int, int]:
    """Undo the turn of one code pair."""
    if turn == 0 or first == second == 0:
        return first, second
    m = (1 << (bits - 1)) - 1
    x, y, z = unfolded(first, second, m)
    q = turn >> 1
    p = [0, 0, 0]
    p[q], p[(q + 1) % 3], p[(q + 2) % 3] = x, y, -z if turn & 1 else z
    return folded(p[0], p[1], p[2], m)


def rgb(y: int, co: int, cg: int, bits: int) -> tuple[int, int, int]:
    """YCoCg-R back to red, green, blue."""
    co, cg = (value - (2 << bits) if value >= 1 << bits else value for value in (co, cg))
    t = y - (cg >> 1)
    blue = t - (co >> 1)
    return blue + co, cg + t, blue
