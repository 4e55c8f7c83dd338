"""The spacing of the model before anything is distributed: the lattice's step follows from it if no error is asked for.

It is that of `spacing.model_spacing`, the median over the samples of the spacing of their regions, but of the
positions as they came. A small model is measured whole. Of a larger one the surroundings of some random samples are
measured, which one sweep over the spool collects. They are chosen by a hash of positions: neither the order of the
input nor how it is read leaves a trace.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .areas import FEWEST, Probing, measure, probe
from .bucket import sort_by_path
from .plan import Bucket
from .priority import priorities
from .spacing import model_spacing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .cells import Cells
    from .progress import Progress
    from .spool import Spool
    from .work import Crew

WHOLE = 1 << 16
"""Samples of a model that is measured whole."""

SEEDS = 1 << 13
"""Random samples, about, that say where samples are before they are counted."""

QUERIES = 512
PART = 4
"""Of a region, whose spacing is measured: more places for the same memory."""

_WINDOW = 63
_COARSE = 20  # path bits that tell most samples to be in no cell
_ROW = np.dtype([("xyz", "<f8", (3,))])


@dataclass(slots=True)
class Sketch:
    """Random samples of a stream, about `SEEDS`: those whose hash is small for the number of all.

    Parameters
    ----------
    samples : int
        So far.
    hashes : ndarray, (k,) uint64
        In order, each once: of positions that were seen.
    xyz : ndarray, (k, 3) float64
    """

    samples: int = 0
    hashes: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))
    xyz: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))

    def add(self, other: Sketch) -> None:
        """Join the sketch of more samples."""
        if not other.samples:
            return
        self.samples += other.samples
        hashes, xyz = np.concatenate([self.hashes, other.hashes]), np.concatenate([self.xyz, other.xyz])
        small = np.flatnonzero(hashes <= max(_limit(self.samples), hashes.min()))
        self.hashes, first = np.unique(hashes[small], return_index=True)
        self.xyz = xyz[small[first]]

    def arrays(self) -> list[NDArray[Any]]:
        """Everything, for a journal."""
        return [np.array(self.samples), self.hashes, self.xyz]

    @classmethod
    def from_arrays(cls, arrays: list[NDArray[Any]]) -> Sketch:
        """Inverse of `arrays`."""
        samples, hashes, xyz = arrays
        return cls(int(samples), hashes, xyz)

    @classmethod
    def of(cls, xyz: NDArray[np.float64]) -> Sketch:
        """Draw from some positions."""
        if not len(xyz):
            return cls()
        hashes = _hashes(xyz)
        chosen = np.flatnonzero(hashes <= max(_limit(len(xyz)), hashes.min()))
        return cls(len(xyz), hashes[chosen], xyz[chosen])


def _limit(samples: int) -> np.uint64:
    return np.uint64(min(int(SEEDS / samples * 2.0**64), 2**64 - 1))


def _hashes(xyz: NDArray[np.float64]) -> NDArray[np.uint64]:
    return priorities((np.ascontiguousarray(xyz) + 0.0).view(np.uint64), 0)  # + 0: there is but one zero


def estimate_spacing(
    spool: Spool, cells: Cells, sketch: Sketch, cloud_size: int, crew: Crew, progress: Progress
) -> float:
    """R of the whole model, model units.

    Parameters
    ----------
    spool : Spool
    cells : Cells
        Of the box of all samples, model units.
    sketch : Sketch
        Of all samples.
    cloud_size : int
        M.
    crew, progress
        Threads, and who is told.
    """
    probing = Probing.of(spool.samples, cloud_size)
    if spool.samples <= WHOLE or not cells.depths:
        if not cells.depths:
            return 0.0
        xyz = np.concatenate([spool.read(block, ("xyz",))["xyz"] for block in spool.blocks])
        return model_spacing(*_measure(xyz, cells, probing))
    progress.stage("probe", spool.samples)
    catch = Catch.around(sketch, cells, spool.samples, max(probing.region // PART, 8 * FEWEST))

    def one(number: int) -> tuple[int, NDArray[np.float64], NDArray[np.uint64]]:
        xyz = spool.read(spool.blocks[number], ("xyz",))["xyz"]
        near = xyz[catch.near(xyz)]
        return len(xyz), near, cells.keys(near, catch.window)

    for _, (done, xyz, keys) in crew.map(one, range(len(spool.blocks))):
        catch.add(xyz, keys)
        progress.advance(done)
    spacing = catch.spacing(probing)
    return model_spacing(spacing, np.ones(len(spacing), np.int64))


def _measure(xyz: NDArray[np.float64], cells: Cells, probing: Probing) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Spacings of all regions, and their samples."""
    rows, _ = sort_by_path(np.ascontiguousarray(xyz).view(_ROW)[:, 0], cells, Bucket(0, len(xyz)))
    xyz = np.ascontiguousarray(rows["xyz"])
    areas = measure(cells, probing, cells.fixed(xyz), xyz, _hashes(xyz), 0)
    measured = np.flatnonzero(areas.region & (areas.spacing > 0))
    return areas.spacing[measured], (areas.high - areas.low)[measured]


def _depths(keys: NDArray[np.uint64], few: int, bits: int) -> NDArray[np.int64]:
    """Depth of the deepest cell around each of some sorted paths that holds more than `few` of them."""
    depth = np.zeros(len(keys), np.int64)
    differ = keys[few:] ^ keys[: len(keys) - few]
    common = np.full(len(differ), bits)
    for bit in range(bits):
        common[differ >> np.uint64(bit) > 0] = bits - 1 - bit
    for first in range(few + 1):
        part = depth[first : first + len(common)]
        np.maximum(part, common, out=part)
    return depth


class Catch:
    """Cells around random samples, each halved towards its sample while more than `most` samples are in it.

    Parameters
    ----------
    cells : Cells
        Of all samples.
    key, depth : ndarray, (q,)
        First bits of the path of each cell's sample, in order, and how often the root was halved.
    most : int
    """

    def __init__(self, cells: Cells, key: NDArray[np.uint64], depth: NDArray[np.int64], most: int) -> None:
        self.window, self.most = cells.window(0, _WINDOW), most
        self._cells, self._coarse = cells, cells.window(0, _COARSE)
        self._key, self._depth = key, depth.copy()
        self._low, self._high = np.empty_like(key), np.empty_like(key)
        self._held: list[list[tuple[NDArray[np.float64], NDArray[np.uint64]]]] = [[] for _ in key]
        for number in range(len(key)):
            self._bound(number)
        self._table = self._marked()

    @classmethod
    def around(cls, sketch: Sketch, cells: Cells, samples: int, most: int) -> Catch:
        """Take the deepest cells around the seeds of smallest hash that hold `most` samples by a safe margin."""
        window = cells.window(0, _WINDOW)
        keys = cells.keys(sketch.xyz, window)
        few = max(2, int(2 * most * len(keys) / samples))
        depth = _depths(np.sort(keys), few, window.bits)[np.searchsorted(np.sort(keys), keys[:QUERIES])]
        chosen = list(zip(keys[:QUERIES].tolist(), depth.tolist(), strict=True))
        # Cells are nested or apart: of nested ones only the largest is kept.
        kept, taken = [], set()
        for place, level in sorted(chosen, key=lambda cell: (cell[1], cell[0])):
            if not any((place >> (window.bits - above), above) in taken for above in range(level + 1)):
                taken.add((place >> (window.bits - level), level))
                kept.append((place, level))
        kept.sort()
        key = np.array([cell[0] for cell in kept], np.uint64)
        return cls(cells, key, np.array([cell[1] for cell in kept]), most)

    def near(self, xyz: NDArray[np.float64]) -> NDArray[np.int64]:
        """Positions that may be in a cell."""
        return np.flatnonzero(self._table[self._cells.keys(xyz, self._coarse)])

    def add(self, xyz: NDArray[np.float64], keys: NDArray[np.uint64]) -> None:
        """Keep those positions that are in a cell; one thread only."""
        cell = np.searchsorted(self._low, keys, side="right") - 1
        inside = (cell >= 0) & (keys <= self._high[cell])
        xyz, keys, cell = xyz[inside], keys[inside], cell[inside]
        order = np.argsort(cell, kind="stable")
        ends = np.searchsorted(cell[order], np.arange(len(self._key) + 1))
        for number in np.flatnonzero(np.diff(ends)).tolist():
            part = order[ends[number] : ends[number + 1]]
            self._held[number].append((xyz[part], keys[part]))
            self._halve(number)
        self._table = self._marked()

    def spacing(self, probing: Probing) -> NDArray[np.float64]:
        """Spacings of the cells, where their samples are enough to measure it."""
        counts = np.array([sum(len(keys) for _, keys in held) for held in self._held])
        order = np.argsort(np.concatenate([keys for held in self._held for _, keys in held]), kind="stable")
        xyz = np.concatenate([xyz for held in self._held for xyz, _ in held])[order]
        low = (np.cumsum(counts) - counts)[counts >= FEWEST]
        faces = self._cells.faces(self._cells.fixed(xyz[low]), self._depth[counts >= FEWEST])
        found = probe(xyz, _hashes(xyz), low, low + counts[counts >= FEWEST], faces, probing)
        return found[found > 0]

    def _marked(self) -> NDArray[np.bool_]:
        """First bits of all paths that may be in a cell."""
        shift = np.uint64(self.window.bits - self._coarse.bits)
        table = np.zeros(1 << self._coarse.bits, np.bool_)
        for low, high in zip((self._low >> shift).tolist(), (self._high >> shift).tolist(), strict=True):
            table[low : high + 1] = True
        return table

    def _halve(self, number: int) -> None:
        held = self._held[number]
        while sum(len(keys) for _, keys in held) > self.most and self._depth[number] < self.window.bits:
            self._depth[number] += 1
            self._bound(number)
            low, high = self._low[number], self._high[number]
            kept = [(keys >= low) & (keys <= high) for _, keys in held]
            held[:] = [(xyz[which], keys[which]) for (xyz, keys), which in zip(held, kept, strict=True)]

    def _bound(self, number: int) -> None:
        below = np.uint64((1 << (self.window.bits - int(self._depth[number]))) - 1)
        self._low[number], self._high[number] = self._key[number] & ~below, self._key[number] | below
