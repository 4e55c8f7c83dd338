"""E57 (ASTM E2807) through pye57: all scans of a file, each brought to the file's frame by its pose."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pye57
from numpy.typing import NDArray
from pye57 import libe57
from pye57.utils import convert_spherical_to_cartesian, get_node

from lpc.errors import ScanError
from lpc.points import PointBatch

from .scan import ReadOptions, ScanInfo, unit

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLOR = ("colorRed", "colorGreen", "colorBlue")
_NORMAL = ("nor:normalX", "nor:normalY", "nor:normalZ")
_SCALARS = {"intensity": "intensity", "classification": "classification", "rowIndex": "row_index",
            "columnIndex": "column_index", "returnIndex": "return_index", "returnCount": "return_count",
            "timeStamp": "time_stamp"}  # fmt: skip
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


class E57Scan:
    """All scans of one E57 file, one after another.

    Samples whose state the file calls invalid come as NaN positions, so that they are dropped and counted like any
    record without a position. An attribute that only some of the scans have is zero in the others.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        fields: dict[str, list[Any]] = {}
        with closing(pye57.E57(str(path))) as file:
            headers = [file.get_header(index) for index in range(file.scan_count)]
            for header in headers:
                prototype = libe57.StructureNode(header.points.prototype())
                for name in header.point_fields:
                    fields.setdefault(name, []).append(get_node(prototype, name))
            self._counts = [int(header.point_count) for header in headers]
            crs = _crs(file)
            self._color = _color_range(headers, fields) if _COLOR[0] in fields else (0.0, 255.0)
            attributes, left_out = self._attributes(fields, options)
        self.info = ScanInfo(
            path=path,
            samples_hint=sum(self._counts),
            crs=crs,
            attributes=attributes,
            raw_bytes=path.stat().st_size,
            left_out=left_out,
        )

    def _attributes(
        self, fields: dict[str, list[Any]], options: ReadOptions
    ) -> tuple[dict[str, np.dtype[Any]], dict[str, str]]:
        """Decide what becomes of the fields, whose nodes are by name; also says what is left out and why."""
        left_out: dict[str, str] = {}
        attributes: dict[str, np.dtype[Any]] = {}
        if options.file_normals and all(name in fields for name in _NORMAL):
            attributes["normal"] = np.dtype(np.float32)
        if all(name in fields for name in _COLOR):
            attributes["color"] = np.dtype(np.uint8 if self._color == (0.0, 255.0) else np.uint16)
        for name, nodes in fields.items():
            if name in (*_CARTESIAN, *_SPHERICAL, *_COLOR, *_INVALID) or (name in _NORMAL and "normal" in attributes):
                continue
            attribute = _SCALARS.get(name)
            if attribute is None:
                left_out[name] = "no attribute that pointstream knows"
            elif not options.wants(attribute):
                left_out[attribute] = "not asked for (--attributes all)"
            else:
                attributes[attribute] = _dtype(nodes)
        return attributes, left_out

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples of all scans; see `Scan.batches`."""
        with closing(pye57.E57(str(self.info.path))) as file:
            for index, declared in enumerate(self._counts):
                header = file.get_header(index)
                if declared:
                    for columns in self._columns(file, header, min(size, declared)):
                        yield self._batch(columns, header)

    def _columns(self, file: Any, header: Any, size: int) -> Iterator[dict[str, NDArray[Any]]]:
        """Read the wanted fields of one scan, through buffers that the library fills again and again."""
        present = header.point_fields
        position = next((names for names in (_CARTESIAN, _SPHERICAL) if all(name in present for name in names)), None)
        if position is None:
            raise ScanError(f"{self.info.path}: a scan with neither cartesian nor spherical positions; export it again")
        wanted: dict[str, np.dtype[Any]] = dict.fromkeys(position, np.dtype(np.float64))
        if "normal" in self.info.attributes:
            wanted |= dict.fromkeys(_NORMAL, np.dtype(np.float32))
        if "color" in self.info.attributes:
            wanted |= dict.fromkeys(_COLOR, np.dtype(np.float64))
        wanted |= {name: self.info.attributes[a] for name, a in _SCALARS.items() if a in self.info.attributes}
        wanted[f"{position[0][:9]}InvalidState"] = np.dtype(np.int8)
        arrays = {name: np.zeros(size, dtype) for name, dtype in wanted.items() if name in present}
        buffers = libe57.VectorSourceDestBuffer()
        for name, array in arrays.items():
            buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, size, True, True))
        reader = header.points.reader(buffers)
        while count := reader.read():
            yield {name: array[:count].copy() for name, array in arrays.items()}
        reader.close()

    def _batch(self, columns: dict[str, NDArray[Any]], header: Any) -> PointBatch:
        if _CARTESIAN[0] in columns:
            xyz = np.stack([columns[name] for name in _CARTESIAN], axis=1)
        else:
            xyz = convert_spherical_to_cartesian(np.stack([columns[name] for name in _SPHERICAL], axis=1))
        posed = header.has_pose()
        if posed:
            xyz = xyz @ header.rotation_matrix.T + header.translation
        for name in _INVALID:
            if name in columns:
                xyz[columns[name] != 0] = np.nan
        attributes: dict[str, NDArray[Any]] = {}
        for name, dtype in self.info.attributes.items():
            sources = {"normal": _NORMAL, "color": _COLOR}.get(name)
            if sources is None:
                field = next(field for field, attribute in _SCALARS.items() if attribute == name)
                attributes[name] = columns.get(field, np.zeros(len(xyz), dtype))
            elif not all(source in columns for source in sources):
                attributes[name] = np.zeros((len(xyz), 3), dtype)
            elif name == "normal":
                normals = np.stack([columns[source] for source in sources], axis=1)
                attributes[name] = unit(normals @ header.rotation_matrix.T if posed else normals)
            else:
                low, high = self._color
                values = np.stack([columns[source] for source in sources], axis=1)
                if (low, high) not in ((0.0, 255.0), (0.0, 65535.0)):
                    values = (values - low) / (high - low) * np.iinfo(dtype).max
                attributes[name] = np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)
        return PointBatch(np.ascontiguousarray(xyz, np.float64), attributes)


def _color_range(headers: list[Any], fields: dict[str, list[Any]]) -> tuple[float, float]:
    """Find what black and full intensity are: the limits that the scans state, else those of the stored integers."""
    limits: list[tuple[float, float]] = []
    for header in headers:
        if header.node.isDefined("colorLimits"):
            node = header.node["colorLimits"]
            limits.append((float(node["colorRedMinimum"].value()), float(node["colorRedMaximum"].value())))
    if not limits:
        whole = [node for node in fields["colorRed"] if not isinstance(node, libe57.FloatNode)]
        limits = [(float(node.minimum()), float(node.maximum())) for node in whole]
    low, high = min((a for a, _ in limits), default=0.0), max((b for _, b in limits), default=1.0)
    if low >= 0 and 1 < high <= 255:
        return 0.0, 255.0
    if low >= 0 and 255 < high <= 65535:
        return 0.0, 65535.0
    return low, max(high, low + 1e-9)


def _dtype(nodes: list[Any]) -> np.dtype[Any]:
    """Smallest dtype for a scalar: unsigned integers that fit, else float32, or float64 for scaled and wide ones."""
    if all(isinstance(node, libe57.IntegerNode) for node in nodes):
        low, high = min(node.minimum() for node in nodes), max(node.maximum() for node in nodes)
        for dtype in (np.uint8, np.uint16, np.int32):
            if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
                return np.dtype(dtype)
        return np.dtype(np.int64)
    narrow = all(isinstance(n, libe57.FloatNode) and n.precision() == libe57.FloatPrecision.E57_SINGLE for n in nodes)
    return np.dtype(np.float32 if narrow or nodes[0].elementName() == "intensity" else np.float64)


def _crs(file: Any) -> str | None:
    if not file.root.isDefined("coordinateMetadata"):
        return None
    text = str(file.root["coordinateMetadata"].value()).strip()
    return text if "[" in text and text.endswith("]") else None
