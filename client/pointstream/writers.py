"""Point files from batches of samples: PLY, LAS, LAZ, XYZ and NPZ, written as the batches come.

A file is written beside its target under another name and renamed when it is whole, so that the target is never half
written; on any failure the other file is removed.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lpc.errors import LpcError, StoreError
from lpc.points import PointBatch

SUFFIXES = (".ply", ".las", ".laz", ".xyz", ".npz")

_PLY_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
              "f8": "double"}  # fmt: skip
_WIDE = np.dtype("<f8")
_COPY = 1 << 20
_LAS_MOST = 2**31 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What is to be written.

    Parameters
    ----------
    count : int
        Samples in all batches together.
    attributes : mapping of str to dtype
        Attributes that every batch has, with their value dtypes.
    bounds : sequence of 6 floats
        Box x0, y0, z0, x1, y1, z1 around the samples, model units: LAS lays its integers over it.
    position_error : float
        Error that the positions have already, model units: text is as fine as a thousandth of it, and without a stated
        error gives every digit.
    origin, step : sequence of 3 floats, and float
        Lattice on which the positions stand, as of a model's header: LAS keeps it, and so the positions exactly.
        Without a step LAS takes the finest power of ten that its integers allow.
    crs : str or None
        WKT, kept by LAS and LAZ.
    """

    count: int
    attributes: Mapping[str, np.dtype[Any]]
    bounds: Sequence[float]
    position_error: float = 0.0
    origin: Sequence[float] = (0.0, 0.0, 0.0)
    step: float = 0.0
    crs: str | None = None


def write_points(path: str | Path, batches: Iterator[PointBatch], target: Target) -> list[str]:
    """Write samples to a file whose suffix says the format.

    Parameters
    ----------
    path : str or Path
        ``.ply``: binary little-endian, ``x y z`` double, ``nx ny nz`` float, ``red green blue`` uchar or ushort, others
        as they are; ``.las`` and ``.laz``: version 1.4, what LAS has no field for as extra dimensions; ``.xyz``: text
        ``x y z [intensity] [red green blue] [nx ny nz]``; ``.npz``: arrays ``xyz`` and each attribute by name.
    batches : iterator of PointBatch
        Written one after another, never held together.
    target : Target
        What the batches hold.

    Returns
    -------
    list of str
        Attributes, or ``crs``, that the format has no room for.

    Raises
    ------
    StoreError
        If the suffix is none of `SUFFIXES`, the batches are not what was announced, or the file cannot be written.
    """
    path = Path(path)
    write = _WRITERS.get(path.suffix.lower())
    if write is None:
        kind = path.suffix or "files without a suffix"
        raise StoreError(f"{path}: cannot write {kind}; use one of {', '.join(SUFFIXES)}")
    try:
        with _beside(path) as file:
            return write(file, _counted(path, batches, target), target)
    except LpcError:
        raise
    except ImportError as error:
        raise StoreError(f"{path}: writing it needs {error.name}; install pointstream[client]") from error
    except OSError as error:
        raise StoreError(f"{path}: {error.strerror or error}; nothing was written") from error
    except (ValueError, OverflowError) as error:
        raise StoreError(f"{path}: the format cannot hold these values ({error}); choose another one") from error


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[BinaryIO]:
    """Open a new file in the target's directory that takes its place at the end, or goes."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("w+b") as file:
            yield file
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _counted(path: Path, batches: Iterator[PointBatch], target: Target) -> Iterator[PointBatch]:
    """Pass the batches on and check that they are what was announced: headers are written first."""
    found = 0
    for batch in batches:
        if batch.attributes.keys() != target.attributes.keys():
            came, announced = sorted(batch.attributes), sorted(target.attributes)
            raise StoreError(f"{path}: a batch came with {came}, not {announced}; nothing was written")
        found += len(batch)
        if found > target.count:
            break
        yield batch
    if found != target.count:
        raise StoreError(f"{path}: {found:,} samples came, not {target.count:,}; nothing was written")


def _write_ply(file: BinaryIO, batches: Iterator[PointBatch], target: Target) -> list[str]:
    names = {"normal": ("nx", "ny", "nz"), "color": ("red", "green", "blue")}
    fields: list[tuple[str, str]] = [(axis, "<f8") for axis in "xyz"]
    for name, dtype in target.attributes.items():
        # PLY has no 64-bit integers
        kind = dtype.newbyteorder("<") if dtype.str[1:] in _PLY_TYPES else _WIDE
        fields += [(column, kind.str) for column in names.get(name, (name.replace(" ", "_"),))]
    row = np.dtype(fields)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by pointstream",
        f"element vertex {target.count}",
    ]
    lines += [f"property {_PLY_TYPES[kind[1:]]} {name}" for name, kind in fields]
    file.write("\n".join([*lines, "end_header", ""]).encode())
    for batch in batches:
        rows = np.empty(len(batch), row)
        for axis, name in enumerate("xyz"):
            rows[name] = batch.xyz[:, axis]
        for name, values in batch.attributes.items():
            columns = names.get(name, (name.replace(" ", "_"),))
            for part, column in enumerate(columns):
                rows[column] = values if values.ndim == 1 else values[:, part]
        file.write(rows.data if len(rows) else b"")
    return []


def _write_xyz(file: BinaryIO, batches: Iterator[PointBatch], target: Target) -> list[str]:
    # As many decimals as the positions are good for; without a stated error, all that a float64 has.
    decimals = max(0, int(np.ceil(-np.log10(target.position_error / 1000)))) if target.position_error > 0 else None
    order = [name for name in ("intensity", "color", "normal") if name in target.attributes]
    formats = [f"%.{min(decimals, 17)}f" if decimals is not None else "%.17g"] * 3
    for name in order:
        whole = target.attributes[name].kind in "iu"
        formats += ["%d" if whole else "%.6f" if name == "normal" else "%.9g"] * (1 if name == "intensity" else 3)
    line = " ".join(formats) + "\n"
    for batch in batches:
        columns: list[list[Any]] = batch.xyz.T.tolist()
        for name in order:
            values = batch.attributes[name]
            columns += [values.tolist()] if values.ndim == 1 else values.T.tolist()
        file.write("".join([line % row for row in zip(*columns, strict=True)]).encode())
    return [name for name in target.attributes if name not in order]


def _write_npz(file: BinaryIO, batches: Iterator[PointBatch], target: Target) -> list[str]:
    arrays: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {"xyz": (np.dtype(np.float64), (target.count, 3))}
    for name, dtype in target.attributes.items():
        arrays[name] = (dtype, (target.count, 3) if name in ("normal", "color") else (target.count,))
    # The members of an archive are written one after another, the batches hold all of them at once: each array
    # waits in a file of its own, so that memory holds one batch.
    with contextlib.ExitStack() as stack:
        spools = {name: stack.enter_context(tempfile.TemporaryFile(dir=Path(file.name).parent)) for name in arrays}
        for batch in batches:
            for name, values in (("xyz", batch.xyz), *batch.attributes.items()):
                rows: NDArray[Any] = np.ascontiguousarray(values, dtype=arrays[name][0])
                spools[name].write(rows.data if len(rows) else b"")
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, (dtype, shape) in arrays.items():
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(member, header)
                    spools[name].seek(0)
                    while block := spools[name].read(_COPY):
                        member.write(block)
    return []


def _write_las(file: BinaryIO, batches: Iterator[PointBatch], target: Target) -> list[str]:
    return _las(file, batches, target, compress=False)


def _write_laz(file: BinaryIO, batches: Iterator[PointBatch], target: Target) -> list[str]:
    return _las(file, batches, target, compress=True)


def _las(file: BinaryIO, batches: Iterator[PointBatch], target: Target, *, compress: bool) -> list[str]:
    import laspy  # takes longer to load than a small file to write

    header = laspy.LasHeader(version="1.4", point_format=_point_format(target.attributes))
    header.creation_date, header.generating_software = None, "pointstream"
    header.scales, header.offsets = _las_lattice(target)
    plan, left_out = _las_dimensions(header, target)
    if target.crs is not None:
        left_out += _add_crs(header, target.crs)
    with laspy.open(file, mode="w", header=header, do_compress=compress, closefd=False) as writer:
        for batch in batches:
            points = laspy.ScaleAwarePointRecord.zeros(len(batch), header=header)
            for axis, name in enumerate("XYZ"):
                steps = np.rint((batch.xyz[:, axis] - header.offsets[axis]) / header.scales[axis])
                if not (np.abs(steps) <= _LAS_MOST).all():
                    raise StoreError(f"{file.name}: a position outside {tuple(target.bounds)}; nothing was written")
                points[name] = steps
            for name, dimensions in plan.items():
                values = batch.attributes[name]
                if name == "color" and values.dtype == np.uint8:
                    values = values.astype(np.uint16) * 257
                for part, dimension in enumerate(dimensions):
                    points[dimension] = values if values.ndim == 1 else values[:, part]
            writer.write_points(points)
    return left_out


def _point_format(attributes: Mapping[str, Any]) -> int:
    """Smallest point format of LAS 1.4 that has the colours."""
    return 8 if "nir" in attributes else 7 if "color" in attributes else 6


def _las_lattice(target: Target) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Scales and offsets such that 32-bit integers reach over the bounds."""
    low, high = np.array(target.bounds[:3], np.float64), np.array(target.bounds[3:], np.float64)
    middle, reach = (low + high) / 2, np.maximum((high - low) / 2, np.finfo(np.float64).tiny)
    scales = 10.0 ** np.ceil(np.log10(reach / (_LAS_MOST - 1)))
    origin = np.zeros(3)
    if target.step > 0 and (reach / target.step < _LAS_MOST - 1).all():
        scales, origin = np.full(3, target.step), np.array(target.origin, np.float64)
    # By whole steps from the origin to the middle: positions of a lattice that begins at a corner need every bit.
    return scales, origin + np.rint((middle - origin) / scales) * scales


def _las_dimensions(header: Any, target: Target) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Dimension of every attribute, extra ones added to the header; and attributes that fit nowhere."""
    import laspy

    known = set(header.point_format.dimension_names)
    plan: dict[str, tuple[str, ...]] = {}
    left_out: list[str] = []
    for name, dtype in target.attributes.items():
        if name == "color":
            plan[name] = ("red", "green", "blue")
        elif name in known and _fits(header, name, dtype):
            plan[name] = (name,)
        elif len(name.encode()) > 32 or name in ("X", "Y", "Z"):
            left_out.append(name)
        else:
            # a standard dimension that is too narrow for the values keeps its name free
            plain = f"{name}_"[:32] if name in known else name
            plan[name] = ("nx", "ny", "nz") if name == "normal" else (plain,)
            header.add_extra_dims([laspy.ExtraBytesParams(name=each, type=dtype) for each in plan[name]])
    return plan, left_out


def _fits(header: Any, name: str, dtype: np.dtype[Any]) -> bool:
    """Whether a standard dimension takes all values of a dtype; sub-fields of a byte are taken as they were read."""
    dimension = header.point_format.dimension_by_name(name)
    if dimension.num_bits < 8:
        return dtype == np.uint8
    return bool(np.can_cast(dtype, dimension.dtype, "safe"))


def _add_crs(header: Any, crs: str) -> list[str]:
    try:
        import pyproj

        header.add_crs(pyproj.CRS.from_wkt(crs))
    except Exception:  # pyproj is optional, and refuses what it does not know in many ways
        return ["crs"]
    return []


_WRITERS: dict[str, Callable[[BinaryIO, Iterator[PointBatch], Target], list[str]]] = {
    ".ply": _write_ply, ".las": _write_las, ".laz": _write_laz, ".xyz": _write_xyz, ".npz": _write_npz,
}  # fmt: skip
