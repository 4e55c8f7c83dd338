"""NPZ archives of arrays by name, as `pointstream export` and numpy.savez write them."""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lpc.attributes import MAX_NAME
from lpc.errors import ScanError
from lpc.points import PointBatch

from .scan import ReadOptions, ScanInfo, unit

_POSITION = ("xyz", "points", "positions")


class NpzScan:
    """``xyz`` (n, 3), and where it has them ``normal`` (n, 3), ``color`` (n, 3) and any (n,) by name.

    Arrays are read row by row from the archive, compressed or not, and never as a whole. Colours that are floats are
    fractions of full intensity.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        headers = _headers(path)
        self._position = next((name for name in _POSITION if name in headers), "")
        if not self._position:
            raise ScanError(f"{path}: no array xyz among {', '.join(headers) or 'none'}; save positions as xyz (n, 3)")
        shape = headers[self._position][0]
        if len(shape) != 2 or shape[1] != 3:
            raise ScanError(f"{path}: {self._position} has shape {shape}; positions are (n, 3)")
        left_out: dict[str, str] = {}
        attributes: dict[str, np.dtype[Any]] = {}
        for name, (its, dtype) in headers.items():
            if name == self._position:
                continue
            triple = name in ("normal", "color")
            if dtype.kind not in "iuf" or dtype.itemsize > 8 or its[1:] != ((3,) if triple else ()):
                left_out[name] = f"shape {its} of {dtype} is no attribute"
            elif its[0] != shape[0]:
                raise ScanError(f"{path}: {name} has {its[0]:,} values for {shape[0]:,} samples; the arrays must agree")
            elif name == "normal" and not options.file_normals:
                left_out[name] = f"--normals {options.normals}"
            elif not options.wants(name):
                left_out[name] = "not asked for (--attributes all)"
            else:
                attributes[name[:MAX_NAME]] = _value_dtype(name, dtype)
        self.info = ScanInfo(
            path=path,
            samples_hint=shape[0],
            attributes=attributes,
            raw_bytes=path.stat().st_size,
            left_out=left_out,
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples; see `Scan.batches`."""
        with contextlib.ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(self.info.path))
            position = _Array(archive, self._position, stack)
            others = {name: _Array(archive, name, stack) for name in self.info.attributes}
            for start in range(0, self.info.samples_hint or 0, size):
                count = min(size, (self.info.samples_hint or 0) - start)
                yield PointBatch(
                    position.read(count).astype(np.float64),
                    {name: self._value(name, array.read(count)) for name, array in others.items()},
                )

    def _value(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        if name == "normal":
            return unit(values)
        dtype = self.info.attributes[name]
        if name == "color" and values.dtype.kind == "f":
            values = np.rint(np.clip(np.nan_to_num(values), 0, 1) * 65535)
        return np.ascontiguousarray(values, dtype=dtype)


def _value_dtype(name: str, dtype: np.dtype[Any]) -> np.dtype[Any]:
    if name == "normal":
        return np.dtype(np.float32)
    if name == "color":
        return np.dtype(np.uint8 if dtype == np.uint8 else np.uint16)
    return dtype.newbyteorder("=")


def _headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Shape and dtype by array name."""
    with contextlib.ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        names = [entry.removesuffix(".npy") for entry in archive.namelist() if entry.endswith(".npy")]
        arrays = {name: _Array(archive, name, stack) for name in names}
        return {name: (array.shape, array.dtype) for name, array in arrays.items()}


class _Array:
    """One array of an archive, read from its first row on."""

    def __init__(self, archive: zipfile.ZipFile, name: str, stack: contextlib.ExitStack) -> None:
        self._name = name
        stream = stack.enter_context(archive.open(f"{name}.npy"))
        self.shape, fortran, self.dtype = _npy_header(stream)
        self._columns = self.shape[1] if len(self.shape) > 1 else 1
        self._streams: list[IO[bytes]] = [stream]
        if fortran and len(self.shape) == 2:  # columns one after another: a stream for each
            start = stream.tell()
            for column in range(1, self._columns):
                other = stack.enter_context(archive.open(f"{name}.npy"))
                other.seek(start + column * self.shape[0] * self.dtype.itemsize)
                self._streams.append(other)

    def read(self, count: int) -> NDArray[Any]:
        """Return the next `count` rows."""
        width = self._columns // len(self._streams)
        parts = []
        for stream in self._streams:
            data = stream.read(count * width * self.dtype.itemsize)
            if len(data) < count * width * self.dtype.itemsize:
                raise ScanError(f"array {self._name} ends before its {self.shape[0]:,} rows; the file is damaged")
            parts.append(np.frombuffer(data, self.dtype).reshape(count, width))
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return rows if len(self.shape) > 1 else rows[:, 0]


def _npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    return shape, fortran, dtype
