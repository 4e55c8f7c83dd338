"""Cut a model into blocks of few enough samples, each with the samples around it that its outer ones need."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_HALO = 8.0  # in spacings: the 16 nearest samples of a surface lie within 2.3 of them, on uneven scans within 8
_WEYL = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: its multiples fill the range evenly


class CoarseSample:
    """Some `most` / 2 to `most` samples from all over a stream, the same for any batches it comes in.

    Parameters
    ----------
    most : int
        Samples to hold.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._limit = 1 << 64
        self._keys = np.empty(0, np.uint64)
        self._xyz = np.empty((0, 3))
        self.seen = 0
        """Samples of the stream so far."""

    def add(self, xyz: NDArray[np.float64]) -> None:
        """Take what of the next samples of the stream (n, 3) is to be held."""
        keys = np.arange(self.seen, self.seen + len(xyz), dtype=np.uint64) * _WEYL
        self.seen += len(xyz)
        chosen = keys <= np.uint64(self._limit - 1)
        self._keys = np.concatenate([self._keys, keys[chosen]])
        self._xyz = np.concatenate([self._xyz, xyz[chosen]])
        while len(self._keys) > self._most:
            self._limit //= 2
            kept = self._keys <= np.uint64(self._limit - 1)
            self._keys, self._xyz = self._keys[kept], self._xyz[kept]

    @property
    def xyz(self) -> NDArray[np.float64]:
        """Samples held, (m, 3)."""
        return self._xyz


@dataclass(frozen=True, slots=True)
class Split:
    """A plane across `axis` at `value`; `low` and `high` are splits or numbers of blocks."""

    axis: int
    value: float
    halo: float
    low: Split | int
    high: Split | int


class Blocks:
    """A k-d tree of blocks, cut at medians of a coarse sample.

    Parameters
    ----------
    coarse : ndarray, (m, 3) float64
        Samples from all over the model.
    reach : ndarray, (m,) float64
        Distance of each to its `k`-th neighbour among them.
    k : int
        Neighbours that `reach` spans, and that samples will need.
    samples : int
        Of the model.
    most : int
        Samples of a block, about.
    """

    def __init__(
        self, coarse: NDArray[np.float64], reach: NDArray[np.float64], k: int, samples: int, most: int
    ) -> None:
        # k neighbours of a surface fill a disc of k spacings squared; the spacing shrinks with the root of the density.
        spacing = reach * np.sqrt(np.pi / k) * np.sqrt(len(coarse) / samples)
        self._coarse, self._spacing = coarse, spacing
        self._share = most * len(coarse) / samples
        self.count = 0
        self.root = self._cut(np.arange(len(coarse)))

    def _cut(self, members: NDArray[np.int64]) -> Split | int:
        xyz = self._coarse[members]
        extent = np.ptp(xyz, axis=0) if len(xyz) else np.zeros(3)
        axis = int(np.argmax(extent))
        value = float(np.median(xyz[:, axis])) if len(xyz) else 0.0
        low = xyz[:, axis] < value
        if len(members) <= self._share or not low.any():
            self.count += 1
            return self.count - 1
        halo = _HALO * float(np.percentile(self._spacing[members], 90))
        halo = min(halo, float(extent[axis]) / 8)
        return Split(axis, value, halo, self._cut(members[low]), self._cut(members[~low]))

    def parts(self, xyz: NDArray[np.float64]) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        """Deal samples (n, 3) out to the blocks.

        Yields
        ------
        block : int
        core : ndarray of int64
            Samples that belong to it: every sample to one block.
        halo : ndarray of int64
            Samples beside it.
        """
        everything = np.arange(len(xyz))
        yield from self._deal(self.root, xyz, everything, np.ones(len(xyz), bool))

    def _deal(
        self, at: Split | int, xyz: NDArray[np.float64], members: NDArray[np.int64], core: NDArray[np.bool_]
    ) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.int64]]]:
        if not len(members):
            return
        if isinstance(at, int):
            yield at, members[core], members[~core]
            return
        ahead = xyz[members, at.axis] - at.value
        for side, mine, near in ((at.low, ahead < 0, ahead < at.halo), (at.high, ahead >= 0, ahead >= -at.halo)):
            yield from self._deal(side, xyz, members[near], (core & mine)[near])
