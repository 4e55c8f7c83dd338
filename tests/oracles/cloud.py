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


def read_cloud(
    frame: bytes, samples: int, attributes: list[dict[str, Any]], ancestors: list[Samples] | None = None
) -> Samples:
    """Lattice coordinates under "lattice", codes by attribute name.

    Parameters
    ----------
    ancestors : list of dict
        What this function gave for them, from the root down.
    attributes : list of dict
        The header's entries: `name`, `kind`, `bits`.
    """
    payload = zstandard.ZstdDecompressor().decompress(frame)
    assert payload[0] == 2
    axes, nbits, shift, window, turn, corner_bytes = payload[1:7]
    rotation, flips = axes % 4, axes // 4
    at = 7
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
    if turn == 6:
        guessed_fields(top, corner, shift, nbits, attributes, residuals, rows, (ancestors or [])[-4:])
        turn = 0

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


def interleaved(place: list[int], nbits: int, order: int) -> int:
    """Code of a place in one of the two orders."""
    cells = [(p + order * (2**nbits // 3)) >> max(0, nbits - 7) for p in place]
    return sum((cell >> bit & 1) << (3 * bit + axis) for axis, cell in enumerate(cells) for bit in range(8))


def companies(
    top: list[list[int]], places: list[list[int]], nbits: int
) -> list[list[tuple[bool, int, int]]]:  # fmt: skip
    """Whether of the context, number and weight of each member of each sample's company."""
    orders = [sorted((interleaved(place, nbits, o), j) for j, place in enumerate(places)) for o in (0, 1)]
    found = []
    for i, point in enumerate(top):
        members = []
        for o, line in enumerate(orders):
            s = sum(code < interleaved(point, nbits, o) for code, _ in line)
            members += [(True, line[at][1]) for at in range(s - 2, s + 2) if 0 <= at < len(line)]
        reach = 1 if i % 2 else 2 if i % 4 else 0
        members += [(False, j) for j in (i - reach, i + reach) if reach and j < len(top)]
        sizes = []
        for context, j in members:
            other = places[j] if context else top[j]
            d = 1 + sum((p - q) ** 2 for p, q in zip(point, other, strict=True))
            sizes.append(2 * d.bit_length() + (d >> (d.bit_length() - 2) & 1 if d > 1 else 0))
        found.append([(*member, 64 >> (t - min(sizes))) for member, t in zip(members, sizes, strict=True)])
    return found


def guessed_fields(
    top: list[list[int]], corner: list[int], shift: int, nbits: int, attributes: list[dict[str, Any]],
    residuals: list[list[int]], rows: list[list[int]], ancestors: list[Samples],
) -> None:  # fmt: skip
    """Put the codes of normals and colours into their rows."""
    low, high = ([pick(axis) for axis in zip(*top, strict=True)] for pick in (min, max))
    places, known = [], []
    for cloud in ancestors:
        for j, point in enumerate(cloud["lattice"]):
            place = [(p - c) >> shift for p, c in zip(point, corner, strict=True)]
            if all(a <= p <= b for a, p, b in zip(low, place, high, strict=True)):
                places.append(place)
                known.append((cloud, j))
    company = companies(top, places, nbits)
    layers = [*range(0, len(top), 4), *range(2, len(top), 4), *range(1, len(top), 2)]
    first = 0
    for entry in attributes:
        bits, name = entry["bits"], entry["name"]
        m = (1 << (bits - 1)) - 1
        if entry["kind"] == "scalar":
            first += 2 if bits > 32 else 1
            continue
        if entry["kind"] == "normal":
            there = [point_of(*cloud[name][j], m) for cloud, j in known]
        else:
            there = [ycocg(*cloud[name][j]) for cloud, j in known]
        own: dict[int, tuple[int, int, int]] = {}
        for i in layers:
            weights = sum(weight for _, _, weight in company[i])
            sums = [
                sum(weight * (there[j] if context else own[j])[axis] for context, j, weight in company[i])
                for axis in range(3)
            ]
            if entry["kind"] == "normal":
                pair, own[i] = seen_along(sums, (residuals[first][i], residuals[first + 1][i]), bits)
                rows[first][i], rows[first + 1][i] = pair
            else:
                means = [(2 * total + weights) // (2 * weights) if weights else 0 for total in sums]
                codes = [
                    (mean + residuals[first + c][i]) % ((1 if c == 0 else 2) << bits) for c, mean in enumerate(means)
                ]
                for c in range(3):
                    rows[first + c][i] = codes[c]
                co, cg = (value - (2 << bits) if value >= 1 << bits else value for value in codes[1:])
                own[i] = (codes[0], co, cg)
        first += 2 if entry["kind"] == "normal" else 3


def seen_along(
    sums: list[int], residual: tuple[int, int], bits: int
) -> tuple[tuple[int, int], tuple[int, int, int]]:  # fmt: skip
    """Code pair and point of a normal."""
    m = (1 << (bits - 1)) - 1
    sizes = [abs(value) for value in sums]
    q = sizes.index(max(sizes))
    n = max(1, sum(sizes))
    parts = [sums[(q + i) % 3] for i in (1, 2)]
    pair = [
        (m + sign(part) * ((2 * m * abs(part) + n) // (2 * n)) + r) % (1 << bits)
        for part, r in zip(parts, residual, strict=True)
    ]
    assert max(pair) <= 2 * m
    if pair == [0, 0]:
        return (0, 0), (0, 0, 0)
    x, y, z = unfolded(*pair, m)
    p = [0, 0, 0]
    p[(q + 1) % 3], p[(q + 2) % 3], p[q] = x, y, sign(sums[q]) * z
    return folded(*p, m), (p[0], p[1], p[2])


def point_of(first: int, second: int, m: int) -> tuple[int, int, int]:
    """Integer point of a code pair; 0 of no normal."""
    return (0, 0, 0) if first == second == 0 else unfolded(first, second, m)


def ycocg(red: int, green: int, blue: int) -> tuple[int, int, int]:
    """YCoCg-R with signed chroma."""
    co = red - blue
    t = blue + (co >> 1)
    cg = green - t
    return t + (cg >> 1), co, cg


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
