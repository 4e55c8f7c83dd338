"""LAS and LAZ (COPC is a LAZ file) through laspy and lazrs."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

from lpc.attributes import MAX_NAME
from lpc.errors import ScanError
from lpc.points import PointBatch

from .scan import CUT_SHORT, ReadOptions, ScanInfo, unit

# laspy logs what it also raises; without a handler Python would print it beside our one line.
logging.getLogger("laspy").addHandler(logging.NullHandler())

_COLOR = ("red", "green", "blue")
_VLR_HEADER, _EVLR_HEADER = 54, 60


class LasScan:
    """One LAS or LAZ file, point formats 0 to 10.

    Positions are float64 ``X * scale + offset`` as laspy computes them. ``color`` is uint16 as stored, ``intensity``
    uint16, ``classification`` uint8; with ``attributes="all"`` every other dimension comes under laspy's name, extra
    dimensions included (several values a sample as ``name_0``, ``name_1``, ...).

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        LAS has no normals of its own; extra dimensions named nx, ny, nz (PDAL's NormalX, ...) are taken as such.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        _check_head(path)
        with laspy.open(path, read_evlrs=False) as reader:
            header = reader.header
            _check_length(path, header)
            if _evlrs_are_sane(path, header):
                reader.read_evlrs()
        names = [name for name in header.point_format.dimension_names if name not in ("X", "Y", "Z")]
        self._normal = _normal_names(names) if options.file_normals else ()
        self._color = all(name in names for name in _COLOR)
        left_out: dict[str, str] = {}
        attributes: dict[str, np.dtype[Any]] = {}
        if self._normal:
            attributes["normal"] = np.dtype(np.float32)
        if self._color:
            attributes["color"] = np.dtype(np.uint16)
        self._scalars: dict[str, tuple[str, int | None]] = {}
        empty = laspy.ScaleAwarePointRecord.empty(header.point_format, header.scales, header.offsets)
        for name in names:
            if name in (*_COLOR, *self._normal):
                continue
            if not options.wants(name):
                left_out[name] = "not asked for (--attributes all)"
                continue
            values = np.asarray(empty[name])
            parts = [(name, None)] if values.ndim == 1 else [(f"{name}_{k}", k) for k in range(values.shape[1])]
            for attribute, part in parts:
                self._scalars[attribute[:MAX_NAME]] = (name, part)
                attributes[attribute[:MAX_NAME]] = values.dtype
        self._selection = _selection(options)
        box = (*map(float, header.mins), *map(float, header.maxs))
        crs, why = _crs(header)
        if why:
            left_out["crs"] = why
        self.info = ScanInfo(
            path=path,
            samples_hint=header.point_count,
            bounds_hint=box if np.isfinite(box).all() else None,  # type: ignore[arg-type]
            crs=crs,
            attributes=attributes,
            raw_bytes=path.stat().st_size,
            left_out=left_out,
            scale=tuple(map(float, header.scales)),
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples; see `Scan.batches`."""
        with laspy.open(self.info.path, read_evlrs=False, decompression_selection=self._selection) as reader:
            scales, offsets = reader.header.scales, reader.header.offsets
            for points in reader.chunk_iterator(size):
                xyz = np.empty((len(points), 3))
                for axis, name in enumerate("XYZ"):
                    np.multiply(points.array[name], scales[axis], out=xyz[:, axis])
                    xyz[:, axis] += offsets[axis]
                yield PointBatch(xyz, self._attributes(points))

    def _attributes(self, points: Any) -> dict[str, NDArray[Any]]:
        attributes: dict[str, NDArray[Any]] = {}
        if self._normal:
            attributes["normal"] = unit(np.stack([np.asarray(points[name]) for name in self._normal], axis=1))
        if self._color:
            attributes["color"] = np.stack([points.array[name] for name in _COLOR], axis=1)
        for attribute, (name, part) in self._scalars.items():
            values = np.asarray(points[name])
            wanted = self.info.attributes[attribute]
            attributes[attribute] = np.ascontiguousarray(values if part is None else values[:, part], dtype=wanted)
        return attributes


def _normal_names(names: list[str]) -> tuple[str, ...]:
    for wanted in (("nx", "ny", "nz"), ("normalx", "normaly", "normalz")):
        lower = {name.lower(): name for name in names}
        if all(name in lower for name in wanted):
            return tuple(lower[name] for name in wanted)
    return ()


def _selection(options: ReadOptions) -> Any:
    """Layers to decompress (point formats 6 and up): skipping the unwanted ones saves a third of the time."""
    flag = laspy.DecompressionSelection
    if options.attributes == "all":
        return flag.all()
    base = flag.XY_RETURNS_CHANNEL | flag.Z | flag.CLASSIFICATION | flag.INTENSITY | flag.RGB
    return base | flag.ALL_EXTRA_BYTES if options.file_normals else base


def _check_head(path: Path) -> None:
    """Check the two numbers that laspy believes before it has read what they announce: VLRs and where points begin."""
    with path.open("rb") as file:
        head = file.read(227)
    header, points, vlrs = (int.from_bytes(head[a:b], "little") for a, b in ((94, 96), (96, 100), (100, 104)))
    if len(head) < 227 or header < 227 or header + vlrs * _VLR_HEADER > points or points > path.stat().st_size:
        raise ScanError(f"{path}: its LAS header cannot be true; the file is damaged, copy it again")


def _check_length(path: Path, header: Any) -> None:
    """Check that an uncompressed file is long enough for what it declares."""
    if header.are_points_compressed:
        return
    room = (path.stat().st_size - header.offset_to_point_data) // max(header.point_format.size, 1)
    if room < header.point_count:
        raise ScanError(f"{path}: declares {header.point_count:,} samples, holds {max(room, 0):,}; {CUT_SHORT}")


def _evlrs_are_sane(path: Path, header: Any) -> bool:
    """Whether every extended record ends inside the file: laspy reserves what they declare."""
    if header.version.minor < 4 or not header.number_of_evlrs:
        return False
    length, at = path.stat().st_size, header.start_of_first_evlr
    with path.open("rb") as file:
        for _ in range(header.number_of_evlrs):
            file.seek(min(at, length))
            head = file.read(_EVLR_HEADER)
            if len(head) < _EVLR_HEADER:
                return False
            at += _EVLR_HEADER + int.from_bytes(head[20:28], "little")
    return bool(at <= length)


def _crs(header: Any) -> tuple[str | None, str | None]:
    """WKT of the coordinate system, or why there is none though the file names one."""
    try:
        crs = header.parse_crs()
        return (crs.to_wkt(), None) if crs is not None else (None, None)
    except Exception as error:  # pyproj is optional, and what files hold here is beyond any list of exceptions
        records = [*header.vlrs, *(header.evlrs or ())]
        plain = next((record.string for record in records if isinstance(record, WktCoordinateSystemVlr)), None)
        return (plain, None) if plain else (None, f"cannot be understood ({str(error).splitlines()[0][:80]})")
