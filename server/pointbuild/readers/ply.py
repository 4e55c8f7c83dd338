"""PLY point clouds and meshes: ascii, little- and big-endian; of a mesh the vertices are the samples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpc.errors import ScanError
from lpc.points import PointBatch

from .columns import plan_columns
from .mesh import VertexNormals
from .ply_body import Element, Lists, Rows, read_header, read_rows
from .scan import CUT_SHORT, ReadOptions, ScanInfo

_FACE_LISTS = ("vertex_indices", "vertex_index")


class PlyScan:
    """The vertices of one PLY file.

    Normals from faces are made once, when the first batch is asked for (see `mesh.VertexNormals` for the memory);
    everything else is read in batches.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self._header = read_header(path)
        vertex = self._header.element("vertex", "vertices", "point", "points")
        if vertex is None:
            raise ScanError(f"{path}: a PLY file without an element vertex; nothing in it is a sample")
        self._vertex = vertex
        singles = {prop.name: prop.dtype for prop in vertex.properties if prop.count is None}
        self._check_length(path)
        top, integral = self._color_range(path, singles)
        self._plan = plan_columns(singles, options, color_top=top, color_integral=integral)
        self._faces = _faces(self._header.element("face", "faces"))
        self._make_normals = options.face_normals and self._faces is not None and not self._plan.normal
        self._normals: NDArray[np.float32] | None = None
        attributes = dict(self._plan.dtypes)
        if self._make_normals:
            attributes["normal"] = np.dtype(np.float32)
        left_out = dict(self._plan.left_out)
        for element in self._header.elements:
            if element is not vertex and not (self._make_normals and element is self._faces):
                left_out[element.name] = "samples are the vertices" if element.count else "empty"
        self.info = ScanInfo(
            path=path,
            samples_hint=vertex.count,
            attributes=attributes,
            raw_bytes=path.stat().st_size,
            left_out=left_out,
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the vertices; see `Scan.batches`."""
        if self._make_normals and self._normals is None:
            self._normals = self._face_normals(size)
        done = 0
        for rows in self._rows(self._vertex, size):
            columns = {name: values for name, values in rows.items() if not isinstance(values, Lists)}
            count = len(columns[self._plan.position[0]])
            normals = None if self._normals is None else self._normals[done : done + count]
            yield self._plan.batch(columns, normals)
            done += count

    def _rows(self, element: Element, size: int) -> Iterator[Rows]:
        return read_rows(self.info.path, self._header, element, size)

    def _face_normals(self, size: int) -> NDArray[np.float32]:
        assert self._faces is not None
        names = self._plan.position
        positions = (
            np.stack([_single(rows, name) for name in names], axis=1) for rows in self._rows(self._vertex, size)
        )
        normals = VertexNormals(xyz.astype(np.float64) for xyz in positions)
        for rows in self._rows(self._faces, size):
            lists = next(rows[name] for name in _FACE_LISTS if name in rows)
            assert isinstance(lists, Lists)
            normals.add(lists.counts, lists.values)
        return normals.finish()

    def _check_length(self, path: Path) -> None:
        """Say at once that a binary file of vertices is cut short."""
        first = self._header.elements[0]
        if self._header.text or first is not self._vertex or not first.fixed:
            return
        room = (path.stat().st_size - self._header.offset) // max(first.row.itemsize, 1)
        if room < first.count:
            raise ScanError(f"{path}: declares {first.count:,} rows of {first.name}, holds {room:,}; {CUT_SHORT}")

    def _color_range(self, path: Path, singles: dict[str, np.dtype[Any]]) -> tuple[float | None, bool]:
        """Largest value in the first rows' colours where their dtype does not tell the range."""
        names = [name for name in singles if name.lower() in ("red", "green", "blue", "r", "g", "b")]
        if not names or all(singles[name].kind == "u" for name in names):
            return None, False
        rows = next(read_rows(path, self._header, self._vertex, 1 << 16), None)
        if rows is None:
            return None, False
        values = np.stack([_single(rows, name) for name in names], axis=1).astype(np.float64)
        return float(values.max(initial=0)), False


def _single(rows: Rows, name: str) -> NDArray[Any]:
    values = rows[name]
    assert not isinstance(values, Lists)
    return values


def _faces(element: Element | None) -> Element | None:
    """Return the element if its rows name vertices."""
    if element is None or not element.count:
        return None
    return element if any(p.count is not None and p.name in _FACE_LISTS for p in element.properties) else None
