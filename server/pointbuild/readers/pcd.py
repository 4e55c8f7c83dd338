"""PCD (Point Cloud Library) version 0.7: ascii, binary and binary_compressed; the header through pypcd4."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from pypcd4.pypcd4 import Encoding, MetaData

from lpc.errors import ScanError
from lpc.points import PointBatch

from .columns import plan_columns
from .kernels import lzf_decompress
from .lines import Lines, cast, table
from .scan import CUT_SHORT, ReadOptions, ScanInfo

_MOST_HEADER = 1 << 16
_WINDOW = 1 << 13  # LZF looks back 8 KiB
_BLOCK = 1 << 20


class PcdScan:
    """One PCD file. Records of NaN, which organised clouds are full of, come as they stand.

    ``rgb`` and ``rgba`` are three bytes in a float or an integer. A compressed file is one LZF block of whole columns:
    it is decompressed piece by piece into an unnamed temporary file, so that memory stays bounded.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self._meta, self._offset = _read_header(path)
        self._row = self._meta.build_dtype()
        self._packed = next((name for name in ("rgb", "rgba") if name in (self._row.names or ())), None)
        dtypes = {name: self._row[name] for name in self._row.names or () if not name.startswith("#$%&~~")}
        if self._packed is not None and dtypes[self._packed].itemsize != 4:
            self._packed = None
        if self._packed is not None:
            del dtypes[self._packed]
            dtypes |= dict.fromkeys(("red", "green", "blue"), np.dtype(np.uint8))
        self._plan = plan_columns(dtypes, options)
        self.info = ScanInfo(
            path=path,
            samples_hint=self._meta.points,
            attributes=self._plan.dtypes,
            raw_bytes=path.stat().st_size,
            left_out=self._plan.left_out,
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples; see `Scan.batches`."""
        with self.info.path.open("rb") as file:
            file.seek(self._offset)
            if self._meta.data == Encoding.ASCII:
                blocks = self._ascii(file, size)
            elif self._meta.data == Encoding.BINARY:
                blocks = self._binary(file, size)
            else:
                blocks = self._compressed(file, size)
            for columns in blocks:
                if self._packed is not None:
                    bits = np.ascontiguousarray(columns[self._packed]).view("<u4")
                    columns |= {name: (bits >> shift).astype(np.uint8) for name, shift in _CHANNELS}
                yield self._plan.batch(columns)

    def _ascii(self, file: BinaryIO, size: int) -> Iterator[dict[str, NDArray[Any]]]:
        lines, names, done = Lines(file), self._row.names or (), 0
        while done < self._meta.points and (text := lines.take(min(size, self._meta.points - done))):
            values = table(text)
            if len(values) and values.shape[1] != len(names):
                raise ScanError(
                    f"{self.info.path}: {values.shape[1]} numbers a line for {len(names)} fields; it is damaged"
                )
            if len(values):
                yield {name: cast(values[:, k], self._row[name]) for k, name in enumerate(names)}
            done += len(values)

    def _binary(self, file: BinaryIO, size: int) -> Iterator[dict[str, NDArray[Any]]]:
        done = 0
        while done < self._meta.points:
            wanted = min(size, self._meta.points - done)
            block = np.frombuffer(_whole(file.read(wanted * self._row.itemsize), self._row.itemsize), self._row)
            if len(block):
                yield {name: block[name] for name in self._row.names or ()}
            done += len(block)
            if len(block) < wanted:
                return

    def _compressed(self, file: BinaryIO, size: int) -> Iterator[dict[str, NDArray[Any]]]:
        count = self._meta.points
        compressed, plain = (int(n) for n in np.frombuffer(file.read(8).ljust(8, b"\0"), "<u4"))
        if plain != count * self._row.itemsize:
            raise ScanError(f"{self.info.path}: {plain:,} bytes declared for {count:,} samples; the file is damaged")
        with tempfile.TemporaryFile() as spool:
            if _decompress(file, compressed, spool) != plain:
                raise ScanError(f"{self.info.path}: declares {count:,} samples, holds fewer; {CUT_SHORT}")
            for start in range(0, count, size):
                wanted = min(size, count - start)
                columns: dict[str, NDArray[Any]] = {}
                base = 0
                for name in self._row.names or ():
                    item = self._row[name]
                    spool.seek(base + start * item.itemsize)
                    columns[name] = np.frombuffer(spool.read(wanted * item.itemsize), item)
                    base += count * item.itemsize
                yield columns


_CHANNELS = (("red", 16), ("green", 8), ("blue", 0))


def _whole(data: bytes, item: int) -> bytes:
    return data[: len(data) - len(data) % item]


def _read_header(path: Path) -> tuple[Any, int]:
    """Parse the header; returns it and the byte after it."""
    with path.open("rb") as file:
        lines: list[str] = []
        while file.tell() < _MOST_HEADER:
            raw = file.readline(_MOST_HEADER)
            line = raw.decode("ascii", "replace").strip()
            if not raw:
                break
            if line and not line.startswith("#"):
                lines.append(line)
            if line.upper().startswith("DATA"):
                # Files of version 0.7 may leave COUNT out, which means ones.
                if not any(line.upper().startswith("COUNT") for line in lines):
                    fields = next((line for line in lines if line.upper().startswith("FIELDS")), "")
                    lines.append("COUNT" + " 1" * (len(fields.split()) - 1))
                return MetaData.parse_header(lines), file.tell()
    raise ScanError(f"{path}: a PCD header without a DATA line; the file is cut short, copy it again")


def _decompress(file: BinaryIO, compressed: int, spool: BinaryIO) -> int:
    """Decode one LZF block of `compressed` bytes into `spool`; the number of bytes that came out."""
    target = np.empty(_WINDOW + 4 * _BLOCK, np.uint8)
    state = np.zeros(2, np.int64)
    rest = b""
    filled = written = 0
    while True:
        block = file.read(min(_BLOCK, compressed))
        compressed -= len(block)
        source = np.frombuffer(rest + block, np.uint8)
        state[0] = 0
        while True:
            before = int(state[0])
            if lzf_decompress(source, target, state) < 0:
                raise ScanError("the compressed block is no LZF; the file is damaged")
            spool.write(target[filled : state[1]].tobytes())
            written += int(state[1]) - filled
            keep = min(int(state[1]), _WINDOW)
            target[:keep] = target[state[1] - keep : state[1]].copy()
            filled = state[1] = keep
            if int(state[0]) == before:
                break
        rest = source[int(state[0]) :].tobytes()
        if not block:
            return written
