"""The seeded hash that picks the samples of a node.

A node takes the M samples of smallest priority in its cell that no ancestor has taken: a uniform subsample
(LPC 5). The priority of a sample is a hash of what the model keeps of it, its lattice point and its codes. So it
depends neither on the order of the input nor on the order of work, and a sample decoded from a model has it still.

Samples that are equal in everything share a hash. One of them has it for a priority, and its *copies* come after all
samples that are none, so that no cloud spends samples on what it shows already. Which one is the first cannot be told,
and copies of one sample have equal priorities: a node may take some of them, no matter which.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

COPY = np.uint64(1 << 63)
"""Added to the priority of a copy."""

_GOLDEN = 0x9E3779B97F4A7C15
_WORD = (1 << 64) - 1
_COPY = np.uint64(1 << 63)
_FEW = 16  # samples at one place that are compared with each other


def priorities(words: NDArray[np.uint64], seed: int) -> NDArray[np.uint64]:
    """Priorities of samples as if none was a copy: uniform over 63 bits.

    Parameters
    ----------
    words : ndarray, (n, w) uint64
        What there is of each sample.
    seed : int
        Any 64-bit number. It is mixed before it meets a sample: close seeds give unrelated subsamples.

    Returns
    -------
    ndarray, (n,) uint64
    """
    out = np.empty(len(words), np.uint64)
    _fill(np.uint64(_mixed(_mixed(seed + _GOLDEN) + _GOLDEN)), words, out)
    return out


def _mixed(value: int) -> int:
    value &= _WORD
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _WORD
    return value ^ (value >> 31)


@njit(cache=True, nogil=True)
def _fill(seed: Any, words: Any, out: Any) -> None:
    # A round of the finaliser of SplitMix64 (Steele, Lea and Flood 2014) for each word, and one more.
    for i in range(len(words)):
        value = seed
        for word in range(words.shape[1] + 1):
            if word < words.shape[1]:
                value ^= words[i, word]
            value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            value = (value ^ (value >> np.uint64(31))) + np.uint64(0x9E3779B97F4A7C15)
        out[i] = value >> np.uint64(1)


def defer_copies(places: NDArray[np.uint64], priority: NDArray[np.uint64]) -> None:
    """Make copies come last.

    Parameters
    ----------
    places : ndarray, (n, 3) uint64
        Of the samples, those at one place one after another.
    priority : ndarray, (n,) uint64
        Of `priorities`; changed.
    """
    _defer(places, priority)


@njit(cache=True, nogil=True)
def _defer(places: Any, priority: Any) -> None:
    begin = 0
    while begin < len(priority):
        end = begin + 1
        while (
            end < len(priority)
            and places[end, 0] == places[begin, 0]
            and places[end, 1] == places[begin, 1]
            and places[end, 2] == places[begin, 2]
        ):
            end += 1
        if end - begin > _FEW:
            order = begin + np.argsort(priority[begin:end])
            last = priority[order[0]]
            for i in order[1:]:
                value = priority[i]
                if value == last:
                    priority[i] = value | _COPY
                last = value
        else:
            for i in range(begin + 1, end):
                for j in range(begin, i):
                    if priority[j] == priority[i]:
                        priority[i] |= _COPY
                        break
        begin = end
