"""Two multisets of samples, one to one: whether the model's samples are exactly those of its scans.

Each scan sample is put on the model's lattice. Samples of equal lattice coordinates and attribute codes are paired
first, then those of equal coordinates, then what is left with neighbours (a coordinate on the border of two cells may
be rounded to either by other arithmetic); partners are never further apart than the model's position error. Everything
is a sort and a merge of 64-bit hashes, checked afterwards. Both sides are spread over bucket files by a hash of the
coordinates, so that memory holds one bucket of both at a time.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np

from lpc.lattice import dequantise, quantise
from lpc.octahedral import encode_normals

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.attributes import Attribute
    from lpc.header import Header

    Rows = NDArray[np.void]

BUCKET_SAMPLES = 1 << 20
MOST_BUCKETS = 256
SLACK = 1e-9
"""Relative, on the position error: distances are computed anew."""
MOST_LEFTOVERS = 1 << 21
"""More on either side, and the models are plainly different: looking at neighbours would say nothing new."""
_NEIGHBOURS = sorted((off for off in product((-1, 0, 1), repeat=3) if any(off)), key=lambda off: sum(map(abs, off)))


@dataclass(slots=True, kw_only=True)
class MatchReport:
    """What came of it.

    Parameters
    ----------
    samples_in, samples_out : int
        Of the scans and of the model.
    missing, surplus : int
        Samples of the scans, and of the model, without a partner.
    max_position_error : float
        Largest distance of partners, model units.
    max_normal_error_degrees : float or None
        Largest angle of partners that both have a normal; None if normals were not compared.
    max_color_error : int or None
        Largest difference of a colour channel of partners; None if colours were not compared.
    differing : dict of str to int
        Partners whose values differ by more than the model allows, by attribute; for normals: one has a normal and the
        other none.
    not_compared : dict of str to str
        The model's other attributes, and why.
    """

    samples_in: int = 0
    samples_out: int = 0
    missing: int = 0
    surplus: int = 0
    max_position_error: float = 0.0
    max_normal_error_degrees: float | None = None
    max_color_error: int | None = None
    differing: dict[str, int] = field(default_factory=dict)
    not_compared: dict[str, str] = field(default_factory=dict)


class Matcher:
    """Takes samples of both sides in any order, then pairs them.

    Parameters
    ----------
    header : Header
        Of the model: lattice and attributes.
    names : sequence of str
        Attributes to compare, with the model's value those that have one everywhere.
    folder : Path
        For the bucket files.
    """

    def __init__(self, header: Header, names: list[str], folder: Path) -> None:
        self._header = header
        self._attributes = [attribute for attribute in header.attributes if attribute.name in names]
        columns = [(item.name, item.dtype, (3,) if item.kind != "scalar" else ()) for item in self._attributes]
        self._row = np.dtype([("lattice", "<i8", (3,)), ("xyz", "<f8", (3,)), *columns])
        self._count = min(MOST_BUCKETS, header.samples // BUCKET_SAMPLES + 1)
        self._stack = ExitStack()
        self._files: list[list[BinaryIO]] = [
            [self._stack.enter_context((folder / f"{side}{number}").open("w+b")) for number in range(self._count)]
            for side in ("in", "out")
        ]
        self._constants = {name: constant for name, constant in header.constants.items() if name in names}
        self.report = MatchReport(
            differing=dict.fromkeys([*(item.name for item in self._attributes), *self._constants], 0)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def add_in(self, xyz: NDArray[np.float64], values: Mapping[str, NDArray[Any]]) -> None:
        """Take samples of a scan; positions finite."""
        with np.errstate(invalid="ignore"):  # a sample beyond all lattices simply has no partner
            lattice = quantise(xyz, np.asarray(self._header.origin), self._header.step)
        self.report.samples_in += len(xyz)
        for name, constant in self._constants.items():
            self.report.differing[name] += _differ(values[name], constant.fill(len(xyz)))
        self._spread(0, lattice, xyz, values)

    def add_out(self, lattice: NDArray[np.int64], values: Mapping[str, NDArray[Any]]) -> None:
        """Take samples of the model."""
        xyz = dequantise(lattice, np.asarray(self._header.origin), self._header.step)
        self.report.samples_out += len(xyz)
        self._spread(1, lattice, xyz, values)

    def match(self) -> MatchReport:
        """Pair everything that was added."""
        leftovers: list[list[Rows]] = [[], []]
        for number in range(self._count):
            ours, theirs = self._load(0, number), self._load(1, number)
            for keys in (self._hash_all, _hash_lattice):
                ours, theirs = self._pair(ours, theirs, keys(ours), keys(theirs))
            leftovers[0].append(ours)
            leftovers[1].append(theirs)
        ours, theirs = (np.concatenate(side) for side in leftovers)
        if max(len(ours), len(theirs)) <= MOST_LEFTOVERS:
            for offset in _NEIGHBOURS:
                if not (len(ours) and len(theirs)):
                    break
                moved = _hash_integers(np.asarray(ours["lattice"]) + np.array(offset))
                ours, theirs = self._pair(ours, theirs, moved, _hash_lattice(theirs))
        self.report.missing, self.report.surplus = len(ours), len(theirs)
        return self.report

    def _spread(
        self, side: int, lattice: NDArray[np.int64], xyz: NDArray[np.float64], values: Mapping[str, NDArray[Any]]
    ) -> None:
        rows = np.empty(len(xyz), self._row)
        rows["lattice"], rows["xyz"] = lattice, xyz
        for attribute in self._attributes:
            rows[attribute.name] = values[attribute.name]
        bucket = (_hash_integers(lattice) % np.uint64(self._count)).astype(np.int64)
        order = np.argsort(bucket, kind="stable")
        ends = np.searchsorted(bucket[order], np.arange(self._count + 1))
        for number in range(self._count):
            if ends[number] < ends[number + 1]:
                self._files[side][number].write(rows[order[ends[number] : ends[number + 1]]].tobytes())

    def _load(self, side: int, number: int) -> Rows:
        file = self._files[side][number]
        file.seek(0)
        return np.frombuffer(file.read(), self._row)

    def _hash_all(self, rows: Rows) -> NDArray[np.uint64]:
        columns = [np.asarray(rows["lattice"])]
        for attribute in self._attributes:
            codes = _codes(attribute, rows[attribute.name])
            columns.append(codes.reshape(len(rows), attribute.components).astype(np.uint64).view(np.int64))
        return _hash_integers(np.concatenate(columns, axis=1))

    def _pair(
        self, ours: Rows, theirs: Rows, our_keys: NDArray[np.uint64], their_keys: NDArray[np.uint64]
    ) -> tuple[Rows, Rows]:
        """Pair rows of equal keys; give back those without a partner."""
        left, right = _merge(our_keys, their_keys)
        distance = np.sqrt(((ours["xyz"][left] - theirs["xyz"][right]) ** 2).sum(axis=1))
        near = distance <= self._header.position_error * (1 + SLACK)
        left, right, distance = left[near], right[near], distance[near]
        if len(left):
            self.report.max_position_error = max(self.report.max_position_error, float(distance.max()))
            self._compare(ours[left], theirs[right])
        alone = np.ones(len(ours), dtype=bool), np.ones(len(theirs), dtype=bool)
        alone[0][left], alone[1][right] = False, False
        return ours[alone[0]], theirs[alone[1]]

    def _compare(self, ours: Rows, theirs: Rows) -> None:
        for attribute in self._attributes:
            a, b = ours[attribute.name], theirs[attribute.name]
            if attribute.kind == "normal":
                angle, differing = _angles(a, b)
                before = self.report.max_normal_error_degrees or 0.0
                self.report.max_normal_error_degrees = max(before, angle)
            elif attribute.kind == "color":
                apart = np.abs(a.astype(np.int64) - b).max(axis=1, initial=0)
                self.report.max_color_error = max(self.report.max_color_error or 0, int(apart.max(initial=0)))
                differing = int((apart > attribute.max_error).sum())
            else:
                differing = _differ(a, b)
            self.report.differing[attribute.name] += differing


def _codes(attribute: Attribute, values: NDArray[Any]) -> NDArray[Any]:
    if attribute.kind == "normal":
        return encode_normals(values, attribute.bits)
    return attribute.encode(values)


def _hash_lattice(rows: Rows) -> NDArray[np.uint64]:
    return _hash_integers(np.asarray(rows["lattice"]))


def _hash_integers(columns: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Hash rows of integers (n, m) to 64 bits (the finaliser of splitmix64 after each column)."""
    state = np.zeros(len(columns), np.uint64)
    for column in np.ascontiguousarray(columns).view(np.uint64).T:
        state += column + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return state


def _merge(ours: NDArray[np.uint64], theirs: NDArray[np.uint64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Places of partners: the i-th of a key on one side with the i-th of it on the other."""
    left, right = np.argsort(ours, kind="stable"), np.argsort(theirs, kind="stable")
    a, b = ours[left], theirs[right]
    rank = np.arange(len(a)) - np.searchsorted(a, a)
    first = np.searchsorted(b, a)
    has = rank < np.searchsorted(b, a, side="right") - first
    return left[has], right[(first + rank)[has]]


def _differ(a: NDArray[Any], b: NDArray[Any]) -> int:
    different = a != b
    if a.dtype.kind == "f":
        different &= ~(np.isnan(a) & np.isnan(b))
    return int(different.reshape(len(a), -1).any(axis=1).sum())


def _angles(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[float, int]:
    """Largest angle in degrees of pairs that both have a direction, and how many have one on one side only."""
    wide_a, wide_b = np.nan_to_num(a.astype(np.float64)), np.nan_to_num(b.astype(np.float64))
    has_a, has_b = wide_a.any(axis=1), wide_b.any(axis=1)
    both = has_a & has_b
    wide_a, wide_b = wide_a[both], wide_b[both]
    sine = np.linalg.norm(np.cross(wide_a, wide_b), axis=1)
    angle = np.degrees(np.arctan2(sine, (wide_a * wide_b).sum(axis=1)))
    return float(angle.max(initial=0.0)), int((has_a != has_b).sum())
