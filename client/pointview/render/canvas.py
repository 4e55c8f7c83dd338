"""Memory that pictures of one size are made in, one after the other.

Memory that is new to a process is cleared by the system page by page, which costs more than what a frame writes there.
So what a frame needs for itself stays, and what it gives away is written again as soon as nobody holds it any more.
"""

from __future__ import annotations

import math
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray


class Canvas:
    """Arrays for pictures of `height` by `width` pixels.

    Attributes
    ----------
    keys : (threads, padded) uint64
        A key image for each thread.
    side : (h, w) float32
        Sides of the splats that are seen.
    holes, sources : (h * w,) int32
        Pixels in holes, and what they show instead.

    All of them hold what the last frame left there.
    """

    def __init__(self, height: int, width: int, threads: int, padded: int) -> None:
        self.shape = height, width
        self.keys = np.empty((threads, padded), dtype=np.uint64)
        self.side = np.empty((height, width), dtype=np.float32)
        self.holes, self.sources = (np.empty(height * width, dtype=np.int32) for _ in range(2))
        self._free: dict[int, list[NDArray[np.uint8]]] = {}

    def empty(self, dtype: DTypeLike, *more: int) -> NDArray[Any]:
        """Return an array (h, w, *more) of any content, to be given away.

        Its memory is given out again once it and all views of it are gone.
        """
        shape, dtype = (*self.shape, *more), np.dtype(dtype)
        size = math.prod(shape) * dtype.itemsize
        free = self._free.setdefault(size, [])
        memory = free.pop() if free else np.empty(size, dtype=np.uint8)
        array: NDArray[Any] = np.frombuffer(memory.data, dtype)  # of all its views it is the base, and `memory` is not
        weakref.finalize(array, free.append, memory).atexit = False
        return array.reshape(shape)
