"""PLY (Turk, 1994): the header through plyfile, the rows of an element in batches.

plyfile maps or loads whole elements, rows with lists one by one in Python; the rows here come in batches of bounded
memory, in numpy.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyListProperty

from lpc.errors import ScanError

from .kernels import gather, walk_bytes, walk_words
from .lines import MOST, Lines, cast, numbers, table
from .scan import CUT_SHORT

_MOST_HEADER = 1 << 20
_BLOCK = 4 << 20


class Lists(NamedTuple):
    """A list property of some rows: `counts` (n,), and all `values` one after another."""

    counts: NDArray[np.int64]
    values: NDArray[Any]


Rows = dict[str, "NDArray[Any] | Lists"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Property:
    """One property: `dtype` of a value in the file's byte order, `count` dtype before a list or None."""

    name: str
    dtype: np.dtype[Any]
    count: np.dtype[Any] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Element:
    """One element: `count` rows of `properties`."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def fixed(self) -> bool:
        """No property is a list, so all rows are equally long."""
        return all(prop.count is None for prop in self.properties)

    @property
    def row(self) -> np.dtype[Any]:
        """Structured dtype of a row without lists."""
        return np.dtype([(prop.name, prop.dtype) for prop in self.properties])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """A parsed header; the rows of all elements follow each other from byte `offset`."""

    text: bool
    big_endian: bool
    offset: int
    elements: tuple[Element, ...]

    def element(self, *names: str) -> Element | None:
        """First element of one of these names."""
        return next((element for element in self.elements if element.name in names), None)


def read_header(path: Path) -> PlyHeader:
    """Parse the header.

    Raises
    ------
    ScanError
        If there is no end of it within 1 MiB.
    plyfile.PlyParseError
        If plyfile finds it malformed.
    """
    with path.open("rb") as file:
        head = file.read(_MOST_HEADER)
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r)", head)
    if end is None:
        raise ScanError(f"{path}: a PLY header without end_header; {CUT_SHORT}")
    text = head[: end.end()].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"[ \t]+\n", b"\n", text)
    counts = [int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+(\d+)$", text, re.MULTILINE)]
    # plyfile has no public way to parse a header alone; with all counts at zero the header is the whole file.
    empty = re.sub(rb"^(element[ \t]+\S+[ \t]+)\d+$", rb"\g<1>0", text, flags=re.MULTILINE)
    ply = PlyData.read(io.BytesIO(empty))
    elements = tuple(
        Element(
            name=element.name, count=count, properties=tuple(_property(p, ply.byte_order) for p in element.properties)
        )
        for element, count in zip(ply.elements, counts, strict=True)
    )
    return PlyHeader(text=ply.text, big_endian=ply.byte_order == ">", offset=end.end(), elements=elements)


def _property(prop: Any, order: str) -> Property:
    order = "<" if order == "=" else order
    if isinstance(prop, PlyListProperty):
        count, value = prop.list_dtype(order)
        if np.dtype(count).kind == "f":
            raise ScanError(
                f"property {prop.name}: a list whose length is a float; write the file with integer lengths"
            )
        return Property(name=prop.name, dtype=np.dtype(value), count=np.dtype(count))
    return Property(name=prop.name, dtype=np.dtype(prop.dtype(order)), count=None)


def read_rows(path: Path, header: PlyHeader, element: Element, size: int) -> Iterator[Rows]:
    """Read the rows of one element, at most `size` at a time; what stands before it is skipped.

    Raises
    ------
    ScanError
        If the file ends before the declared number of rows, or a row cannot be.
    """
    with path.open("rb") as file:
        file.seek(header.offset)
        body: _Text | _Binary = _Text(file, path) if header.text else _Binary(file, path, big_endian=header.big_endian)
        for other in header.elements:
            if other is element:
                yield from body.rows(other, size)
                return
            body.skip(other)


def _short(path: Path, element: Element, found: int) -> ScanError:
    return ScanError(f"{path}: declares {element.count:,} rows of {element.name}, holds {found:,}; {CUT_SHORT}")


class _Binary:
    def __init__(self, file: BinaryIO, path: Path, *, big_endian: bool) -> None:
        self._file, self._path, self._big = file, path, big_endian

    def skip(self, element: Element) -> None:
        if element.fixed:
            self._file.seek(element.count * element.row.itemsize, io.SEEK_CUR)
        else:
            for _ in self.rows(element, 1 << 16):
                pass

    def rows(self, element: Element, size: int) -> Iterator[Rows]:
        return self._fixed(element, size) if element.fixed else self._lists(element, size)

    def _fixed(self, element: Element, size: int) -> Iterator[Rows]:
        row = element.row
        done = 0
        while row.itemsize and done < element.count:
            wanted = min(size, element.count - done)
            data = self._file.read(wanted * row.itemsize)
            whole = len(data) // row.itemsize
            if whole:
                block = np.frombuffer(data, row, whole)
                yield {name: block[name] for name in row.names or ()}
            done += whole
            if whole < wanted:
                raise _short(self._path, element, done)

    def _lists(self, element: Element, size: int) -> Iterator[Rows]:
        sizes = np.array([prop.dtype.itemsize for prop in element.properties])
        widths = np.array([prop.count.itemsize if prop.count is not None else 0 for prop in element.properties])
        smallest = int(np.where(widths > 0, widths, sizes).sum())
        rest, done = b"", 0
        while done < element.count:
            block = self._file.read(_BLOCK)
            data = np.frombuffer(rest + block, np.uint8)
            used = 0
            while done < element.count:
                most = min(size, element.count - done, (len(data) - used) // smallest + 1)
                at = np.empty((most, len(sizes) + 1), np.int64)
                found = walk_bytes(data[used:], sizes, widths, self._big, most, at)
                if found < 0:
                    raise ScanError(
                        f"{self._path}: row {done - 1 - found:,} of {element.name} has a list of negative length"
                    )
                if found == 0:
                    break
                yield _from_bytes(data[used:], at[:found], element)
                used += int(at[found - 1, -1])
                done += found
            rest = data[used:].tobytes()
            if done < element.count and (not block or len(rest) > MOST):
                raise _short(self._path, element, done)
        self._file.seek(-len(rest), io.SEEK_CUR)


def _from_bytes(data: NDArray[np.uint8], at: NDArray[np.int64], element: Element) -> Rows:
    rows: Rows = {}
    for k, prop in enumerate(element.properties):
        item = prop.dtype.itemsize
        if prop.count is None:
            rows[prop.name] = gather(data, at[:, k], item).view(prop.dtype)[:, 0]
            continue
        first = at[:, k] + prop.count.itemsize
        counts = (at[:, k + 1] - first) // item
        starts = np.repeat(first, counts) + item * _within(counts)
        rows[prop.name] = Lists(counts, gather(data, starts, item).view(prop.dtype)[:, 0])
    return rows


def _within(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """0, 1, ... for each list anew."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


class _Text:
    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._lines, self._path = Lines(file), path

    def skip(self, element: Element) -> None:
        for _ in self.rows(element, 1 << 16):
            pass

    def rows(self, element: Element, size: int) -> Iterator[Rows]:
        done = 0
        rest = np.empty(0)
        is_list = np.array([prop.count is not None for prop in element.properties])
        while done < element.count:
            most = min(size, element.count - done)
            text = self._lines.take(most)
            if not text:
                raise _short(self._path, element, done)
            try:
                if element.fixed:
                    values = table(text)
                    found = len(values)
                    if found and values.shape[1] != len(is_list):
                        raise ValueError(f"{values.shape[1]} numbers a row for {len(is_list)} properties")
                    block: Rows = {
                        p.name: cast(values[:, k], p.dtype) for k, p in enumerate(element.properties) if found
                    }
                else:
                    words = np.concatenate([rest, numbers(text)])
                    at = np.empty((most, len(is_list) + 1), np.int64)
                    found = walk_words(words, is_list, most, at)
                    if found < 0:
                        raise ValueError("a list of negative length")
                    block = _from_words(words, at[:found], element)
                    rest = words[at[found - 1, -1] if found else 0 :]
            except ValueError as error:
                first = f"{self._path}: {element.name} row {done:,} or one of the next {most:,}"
                raise ScanError(f"{first} cannot be read ({error}); the file is damaged") from error
            if found:
                yield block
            done += found


def _from_words(words: NDArray[np.float64], at: NDArray[np.int64], element: Element) -> Rows:
    rows: Rows = {}
    for k, prop in enumerate(element.properties):
        if prop.count is None:
            rows[prop.name] = cast(words[at[:, k]], prop.dtype)
            continue
        counts = at[:, k + 1] - at[:, k] - 1
        starts = np.repeat(at[:, k] + 1, counts) + _within(counts)
        rows[prop.name] = Lists(counts, cast(words[starts], prop.dtype))
    return rows
