"""Text files in blocks of whole lines, and lines of numbers as arrays."""

from __future__ import annotations

import io
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lpc.errors import ScanError

BLOCK = 1 << 20
MOST = 64 << 20  # bytes held at once, whatever the lines look like


class Lines:
    """Whole lines of a binary stream; lone carriage returns of old Macs end lines too.

    Parameters
    ----------
    file : binary stream
        Read from where it stands.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._rest = b""
        self._mac: bool | None = None
        self.line = 1
        """Number of the next line, counting from where the stream stood."""

    def take(self, most: int) -> bytes:
        """Return at most `most` lines (fewer when they are long), empty at the end of the file.

        Raises
        ------
        ScanError
            If a line is longer than 64 MiB.
        """
        parts: list[bytes] = []
        lines = total = 0
        block, self._rest = self._rest or self._read(), b""
        while block:
            parts.append(block)
            here = block.count(b"\n")
            total += len(block)
            if lines + here >= most or total >= MOST:
                kept = self._cut(block, most - lines if lines + here >= most else here)
                parts[-1], self._rest = block[:kept], block[kept:]
                lines += min(here, most - lines)
                if lines == 0:
                    raise ScanError(f"line {self.line} is longer than {MOST >> 20} MiB; this is no text of numbers")
                break
            lines += here
            block = self._read()
        self.line += lines
        return b"".join(parts)

    def _read(self) -> bytes:
        block = self._file.read(BLOCK)
        if self._mac is None:
            self._mac = b"\r" in block and b"\n" not in block
        return block.replace(b"\r", b"\n") if self._mac else block

    @staticmethod
    def _cut(block: bytes, lines: int) -> int:
        """Length of the first `lines` lines of `block`."""
        if lines <= 0:
            return 0
        return int(np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n"))[lines - 1]) + 1


def table(text: bytes) -> NDArray[np.float64]:
    """Parse lines of equally many blank-separated numbers, (rows, columns); blank lines count for nothing.

    Raises
    ------
    ValueError
        If a word is no number or the lines differ in length.
    """
    if not text.strip():
        return np.empty((0, 0))
    # numpy's C parser: about 40 ns a number, half of what splitting and converting costs.
    return np.loadtxt(io.BytesIO(text), dtype=np.float64, comments=None, ndmin=2)


def numbers(text: bytes) -> NDArray[np.float64]:
    """Parse all blank-separated numbers, whatever the lines.

    Raises
    ------
    ValueError
        If a word is no number.
    """
    words: list[Any] = text.split()
    return np.array(words, dtype=np.float64)


def cast(values: NDArray[np.float64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Give parsed numbers the dtype that the file declares for them.

    Raises
    ------
    ValueError
        If an integer column holds what is no integer of that size.
    """
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        good = (values >= limits.min) & (values <= limits.max) & (values == np.rint(values))
        if not good.all():
            raise ValueError(f"{values[~good][0]:g} is no {dtype.name}")
    with np.errstate(over="ignore"):  # beyond float32: infinite, and dropped as such
        return values.astype(dtype)
