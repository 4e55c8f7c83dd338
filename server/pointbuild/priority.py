"""The seeded hash that picks the samples of a node.

A node takes the M samples of smallest priority in its cell that no ancestor has taken: a uniform subsample
(LPC 5) that depends on the samples' places in the input and the seed, not on the order of work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

_GOLDEN = 0x9E3779B97F4A7C15
_WORD = (1 << 64) - 1


def priorities(first: int, count: int, seed: int) -> NDArray[np.uint64]:
    """Priorities of samples `first` to `first + count - 1` of the input: all different, uniform over 64 bits.

    Parameters
    ----------
    first, count : int
        Places in the input after rejected records have been dropped.
    seed : int
        Any 64-bit number. It is mixed before it meets the place: close seeds give unrelated subsamples.

    Returns
    -------
    ndarray, (count,) uint64
    """
    out = np.empty(count, np.uint64)
    _fill(np.uint64((first + _mixed(_mixed(seed + _GOLDEN) + _GOLDEN)) & _WORD), out)
    return out


def _mixed(value: int) -> int:
    value &= _WORD
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _WORD
    return value ^ (value >> 31)


@njit(cache=True, nogil=True)
def _fill(first: Any, out: Any) -> None:
    # Two rounds of the finaliser of SplitMix64 (Steele, Lea and Flood 2014): a bijection, so nothing ties.
    for i in range(len(out)):
        value = first + np.uint64(i)
        for _ in range(2):
            value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            value = (value ^ (value >> np.uint64(31))) + np.uint64(0x9E3779B97F4A7C15)
        out[i] = value
