"""Wavefront OBJ: the vertices of all objects are the samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpc.errors import ScanError
from lpc.points import PointBatch

from .lines import Lines, numbers, table
from .mesh import VertexNormals
from .scan import ReadOptions, ScanInfo, unit

_SLASH = ord("/")
_FACE_LINES = 1 << 17


class ObjScan:
    """One OBJ file.

    A vertex takes the mean of the normals (``vn``) that faces give it; without ``vn`` the faces make them, and where
    there are as many ``vn`` as vertices and no faces, they belong together in order. Colours after the position
    (``v x y z r g b``) become uint16, or uint8 where they go up to 255.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        counts = {"v": 0, "vn": 0, "f": 0}
        first: NDArray[np.float64] | None = None
        with path.open("rb") as file:
            lines = Lines(file)
            while text := lines.take(_FACE_LINES):
                for kind in counts:
                    chosen, some = select(text, kind)
                    counts[kind] += some
                    if kind == "v" and some and first is None:
                        first = table(chosen)
        if first is None:
            raise ScanError(f"{path}: no line of a vertex (v x y z); nothing in it is a sample")
        self._columns = first.shape[1]
        # x y z, perhaps a weight, perhaps r g b
        self._color_at = self._columns - 3 if self._columns >= 6 else 0
        self._color_top = float(first[:, self._color_at :].max()) if self._color_at else 0.0
        self._counts = counts
        from_file = counts["vn"] > 0 and (counts["f"] > 0 or counts["vn"] == counts["v"])
        self._normals_from = "file" if from_file else "faces" if counts["f"] else ""
        if not (options.file_normals if from_file else options.face_normals):
            self._normals_from = ""
        self._normals: NDArray[np.float32] | None = None
        attributes: dict[str, np.dtype[Any]] = {}
        if self._normals_from:
            attributes["normal"] = np.dtype(np.float32)
        if self._color_at:
            attributes["color"] = np.dtype(np.uint8 if self._color_top > 1 else np.uint16)
        self.info = ScanInfo(path=path, samples_hint=counts["v"], attributes=attributes, raw_bytes=path.stat().st_size)

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the vertices; see `Scan.batches`."""
        if self._normals_from and self._normals is None:
            self._normals = self._make_normals()
        done = 0
        for values in self._tables("v", size):
            attributes: dict[str, NDArray[Any]] = {}
            if self._normals is not None:
                attributes["normal"] = self._normals[done : done + len(values)]
            if self._color_at:
                top = 255 if self._color_top > 1 else 65535
                scale = 1 if self._color_top > 1 else 65535
                colors = np.rint(values[:, self._color_at :] * scale)
                attributes["color"] = np.clip(colors, 0, top).astype(self.info.attributes["color"])
            yield PointBatch(np.ascontiguousarray(values[:, :3]), attributes)
            done += len(values)

    def _tables(self, kind: str, size: int) -> Iterator[NDArray[np.float64]]:
        with self.info.path.open("rb") as file:
            lines = Lines(file)
            while True:
                line = lines.line
                text = lines.take(size)
                if not text:
                    return
                chosen, some = select(text, kind)
                if not some:
                    continue
                try:
                    values = table(chosen)
                except ValueError as error:
                    where = f"{self.info.path}: a line {kind} after line {line:,}"
                    raise ScanError(f"{where} cannot be read ({error}); the file is damaged") from error
                if kind == "v" and values.shape[1] != self._columns:
                    raise ScanError(f"{self.info.path}: vertices of {self._columns} and of {values.shape[1]} numbers")
                yield values

    def _make_normals(self) -> NDArray[np.float32]:
        if self._normals_from == "faces":
            mesh = VertexNormals(values[:, :3] for values in self._tables("v", _FACE_LINES))
            for counts, corners, _ in self._faces():
                mesh.add(counts, corners)
            return mesh.finish()
        given = np.concatenate([unit(values[:, :3]) for values in self._tables("vn", _FACE_LINES)])
        if not self._counts["f"]:
            return given
        sums = np.zeros((self._counts["v"], 3), np.float32)
        for _, corners, normals in self._faces():
            used = normals >= 0
            if len(corners) and not (corners.min() >= 0 and corners.max() < len(sums) and normals.max() < len(given)):
                raise ScanError(f"{self.info.path}: a face names a vertex or normal that there is not; it is damaged")
            for axis in range(3):
                np.add.at(sums[:, axis], corners[used], given[normals[used], axis])
        return unit(sums)

    def _faces(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
        """Corners a face, vertex of each corner and normal of each corner (-1: none), counted from 0."""
        seen_v = seen_n = 0
        with self.info.path.open("rb") as file:
            lines = Lines(file)
            while text := lines.take(_FACE_LINES):
                yield from parse_faces(text, seen_v, seen_n)
                seen_v += select(text, "v")[1]
                seen_n += select(text, "vn")[1]


def select(text: bytes, kind: str) -> tuple[bytes, int]:
    """Keep the lines of one kind, without the word that names it; returns them and their number."""
    data, starts, lengths, chosen = _lines_of(text, kind)
    if not chosen.any():
        return b"", 0
    kept = data.copy()
    for k in range(len(kind)):
        kept[starts[chosen] + k] = ord(" ")
    return kept[np.repeat(chosen, lengths)].tobytes(), int(chosen.sum())


def _lines_of(
    text: bytes, kind: str
) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    data = np.frombuffer(text if text.endswith(b"\n") else text + b"\n", np.uint8)
    ends = np.flatnonzero(data == ord("\n")) + 1
    starts = np.concatenate([[0], ends[:-1]])
    lengths = ends - starts
    chosen = lengths > len(kind) + 1
    for k, letter in enumerate(kind.encode() + b" "):
        here = data[np.minimum(starts + k, len(data) - 1)]
        chosen &= (here == letter) | ((letter == ord(" ")) & (here == ord("\t")))
    return data, starts, lengths, chosen


def parse_faces(
    text: bytes, vertices: int, normals: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
    """Read the ``f`` lines of a block; lines of one form (``1``, ``1/2``, ``1//3``, ``1/2/3``) come together.

    Parameters
    ----------
    text : bytes
        Whole lines.
    vertices, normals : int
        Lines ``v`` and ``vn`` before the block: negative indices count back from where they stand.
    """
    padded, _ = text.replace(b"//", b"/0/"), None
    data, starts, lengths, chosen = _lines_of(padded, "f")
    if not chosen.any():
        return
    before_v = vertices + np.cumsum(_lines_of(padded, "v")[3])
    before_n = normals + np.cumsum(_lines_of(padded, "vn")[3])
    blank = data <= ord(" ")
    words = np.add.reduceat(~blank & np.concatenate([[True], blank[:-1]]), starts, dtype=np.int64) - 1
    slashes = np.add.reduceat(data == _SLASH, starts, dtype=np.int64)
    form = np.where(words > 0, slashes // np.maximum(words, 1), 0)
    if (chosen & ((words < 1) | (form * words != slashes) | (form > 2))).any():
        raise ScanError("a face line (f) mixes forms of corners; the file is damaged")
    for slash in range(3):
        these = chosen & (form == slash)
        if not these.any():
            continue
        kept = data.copy()
        kept[starts[these]] = ord(" ")
        kept[kept == _SLASH] = ord(" ")
        values = numbers(kept[np.repeat(these, lengths)].tobytes()).astype(np.int64).reshape(-1, slash + 1)
        counts = words[these]
        corner = _absolute(values[:, 0], np.repeat(before_v[these], counts))
        normal = _absolute(values[:, 2], np.repeat(before_n[these], counts)) if slash == 2 else np.full(len(corner), -1)
        yield counts, corner, normal


def _absolute(index: NDArray[np.int64], seen: NDArray[np.int64]) -> NDArray[np.int64]:
    """From OBJ's count from 1, or back from the last one seen, to a count from 0."""
    return np.where(index < 0, seen + index, index - 1)
