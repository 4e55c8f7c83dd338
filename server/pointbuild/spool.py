"""The samples on disk in input order: decoded once, read as often as the passes need."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from lpc.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Column:
    """One value per sample, of `components` numbers of `dtype`."""

    name: str
    dtype: np.dtype[Any]
    components: int = 1

    @property
    def itemsize(self) -> int:
        """Bytes per sample."""
        return self.dtype.itemsize * self.components

    def shape(self, samples: int) -> tuple[int, ...]:
        """Shape of the array of so many samples."""
        return (samples,) if self.components == 1 else (samples, self.components)


@dataclass(frozen=True, slots=True)
class Block:
    """A run of consecutive samples: `first` is the place of its first in the input."""

    first: int
    samples: int
    offset: int


class Spool:
    """A file of blocks, each the columns of a run of samples one after another.

    Parameters
    ----------
    path : Path
        Is created; removing it is the owner's part.
    columns : tuple of Column
        ``xyz`` first, then what the attributes need.
    blocks : list of Block, optional
        Those that the file at `path` holds already; without them it begins empty.
    """

    def __init__(self, path: Path, columns: tuple[Column, ...], blocks: list[Block] | None = None) -> None:
        self.columns = columns
        self.blocks = blocks or []
        self.samples = sum(block.samples for block in self.blocks)
        self._length = sum(column.itemsize for column in columns) * self.samples
        fresh = 0 if blocks else os.O_TRUNC
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | fresh | os.O_CLOEXEC, 0o600)

    def reserve(self, samples: int) -> Block:
        """Make room for a block after all others."""
        block = Block(self.samples, samples, self._length)
        self._length += sum(column.itemsize for column in self.columns) * samples
        if samples:
            self.blocks.append(block)
        self.samples += samples
        return block

    def write(self, block: Block, values: Mapping[str, NDArray[Any]]) -> None:
        """Write the samples of a block; any thread may."""
        offset = block.offset
        for column in self.columns:
            data = np.ascontiguousarray(values[column.name], dtype=column.dtype)
            write_all(self._file, data, offset)
            offset += data.nbytes

    def read(self, block: Block, names: tuple[str, ...] | None = None) -> dict[str, NDArray[Any]]:
        """Columns of a block by name; all of them if no names are given."""
        offset, values = block.offset, {}
        for column in self.columns:
            if names is None or column.name in names:
                data = np.empty(column.shape(block.samples), column.dtype)
                read_all(self._file, data, offset)
                values[column.name] = data
            offset += column.itemsize * block.samples
        return values

    def cut(self, block: Block) -> None:
        """Give back the room of a block and of all after it; they cannot be read again."""
        os.truncate(self._file, block.offset)

    def close(self) -> None:
        """Close the file; twice is fine."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def write_all(file: int, values: NDArray[Any], offset: int) -> None:
    """`os.pwrite` until all of a contiguous array is written."""
    data = values.reshape(-1).view(np.uint8).data
    while data:
        written = os.pwrite(file, data, offset)
        data, offset = data[written:], offset + written


def read_all(file: int, values: NDArray[Any], offset: int) -> None:
    """`os.preadv` until a contiguous array is full.

    Raises
    ------
    BuildError
        If the file ends before.
    """
    data = values.reshape(-1).view(np.uint8).data
    while data:
        got = os.preadv(file, [data], offset)
        if not got:
            raise BuildError("a temporary file of the build is shorter than it was: is another program cleaning up?")
        data, offset = data[got:], offset + got
