"""From named columns, as PLY, PCD and text files have them, to samples.

Programs disagree about names; this module knows the usual ones (`nx` and `normal_x`, `red` and `r`, CloudCompare's
`scalar_` prefix) and says which column becomes what.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpc.attributes import MAX_NAME
from lpc.errors import ScanError
from lpc.points import PointBatch

from .scan import ReadOptions, unit

Dtypes = Mapping[str, "np.dtype[Any]"]

_POSITION = (("x", "easting", "east"), ("y", "northing", "north"), ("z", "elevation", "height", "altitude"))
_NORMAL = tuple((f"n{axis}", f"normal_{axis}", f"normal{axis}", f"normals_{axis}", f"n_{axis}") for axis in "xyz")
_COLOR = (("red", "r", "diffuse_red"), ("green", "g", "diffuse_green"), ("blue", "b", "diffuse_blue"))
_SCALARS = {"i": "intensity", "class": "classification"}


def plain_name(name: str) -> str:
    """Lower case, without quotes, units in brackets and CloudCompare's prefix.

    >>> plain_name('"Scalar_Intensity"'), plain_name("X [m]")
    ('intensity', 'x')
    """
    name = re.sub(r"[\[(].*", "", name.strip().strip("\"'")).strip().lower()
    return name.removeprefix("scalar_")


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnPlan:
    """Which columns make the position, the normal, the colour and the scalars of a sample.

    Parameters
    ----------
    position, normal, color : tuple of str
        Column names; empty where there are none (never for position).
    color_scale : float
        Colour = rint(column * color_scale), 65535 for colours written as fractions.
    scalars : mapping of str to str
        Attribute name to column name.
    dtypes : mapping of str to dtype
        Value dtypes of the attributes.
    left_out : mapping of str to str
        Columns that become nothing, and why.
    """

    position: tuple[str, ...]
    normal: tuple[str, ...] = ()
    color: tuple[str, ...] = ()
    color_scale: float = 1.0
    scalars: Mapping[str, str] = field(default_factory=dict)
    dtypes: Dtypes = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)

    def batch(self, columns: Mapping[str, NDArray[Any]], extra_normal: NDArray[np.float32] | None = None) -> PointBatch:
        """Make samples from columns of equal length; `extra_normal` stands in where the columns hold no normals."""
        xyz = _stack(columns, self.position, np.dtype(np.float64))
        attributes: dict[str, NDArray[Any]] = {}
        if self.normal:
            attributes["normal"] = unit(_stack(columns, self.normal, np.dtype(np.float32)))
        elif extra_normal is not None:
            attributes["normal"] = extra_normal
        if self.color:
            attributes["color"] = self._colors(columns)
        for name, column in self.scalars.items():
            attributes[name] = np.ascontiguousarray(columns[column], dtype=self.dtypes[name])
        return PointBatch(xyz, attributes)

    def _colors(self, columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        dtype = self.dtypes["color"]
        if all(columns[name].dtype.newbyteorder("=") == dtype for name in self.color):
            return _stack(columns, self.color, dtype)
        values = np.rint(_stack(columns, self.color, np.dtype(np.float64)) * self.color_scale)
        top = np.iinfo(dtype).max
        if not ((values >= 0) & (values <= top)).all():
            worst = values[~((values >= 0) & (values <= top))][0]
            raise ScanError(f"a colour of {worst:g} among colours from 0 to {top}; rescale the colours or drop them")
        return values.astype(dtype)


def plan_columns(
    dtypes: Dtypes, options: ReadOptions, *, color_top: float | None = None, color_integral: bool = False
) -> ColumnPlan:
    """Decide what the columns mean.

    Parameters
    ----------
    dtypes : mapping of str to dtype
        Columns in the order of the file.
    options : ReadOptions
        What is wanted.
    color_top : float or None
        Largest value seen in colour columns that are not uint8 or uint16; None where unknown (taken as 1.0).
    color_integral : bool
        Those values were whole numbers, so a largest value of 1 does not mean fractions.

    Raises
    ------
    ScanError
        If x, y or z is missing.
    """
    by_name: dict[str, str] = {}
    for column in dtypes:
        by_name.setdefault(plain_name(column), column)
    position = _find(by_name, _POSITION)
    if not position:
        raise ScanError(f"no columns x, y, z among {', '.join(dtypes) or 'none'}; name or order the columns so")
    normal, color = _find(by_name, _NORMAL), _find(by_name, _COLOR)
    left_out: dict[str, str] = {}
    out: dict[str, np.dtype[Any]] = {}
    used = {*position, *normal, *color}
    if normal and not options.file_normals:
        left_out["normal"] = f"--normals {options.normals}"
        normal = ()
    if normal:
        out["normal"] = np.dtype(np.float32)
    scale = 1.0
    if color:
        out["color"], scale = _color_dtype([dtypes[name] for name in color], color_top, color_integral)
    scalars: dict[str, str] = {}
    for column, dtype in dtypes.items():
        name = _attribute_name(column)
        if column in used:
            continue
        if dtype.kind not in "iuf":
            left_out[name] = "not a number"
        elif not options.wants(name):
            left_out[name] = "not asked for (--attributes all)"
        elif name in out:
            left_out[column] = f"a second {name}"
        else:
            scalars[name] = column
            out[name] = dtype.newbyteorder("=")
    return ColumnPlan(
        position=position, normal=normal, color=color, color_scale=scale, scalars=scalars, dtypes=out, left_out=left_out
    )


def _attribute_name(column: str) -> str:
    name = plain_name(column)
    return _SCALARS.get(name, name or column)[:MAX_NAME]


def _find(by_name: Mapping[str, str], wanted: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    found = [next((by_name[name] for name in names if name in by_name), None) for names in wanted]
    return tuple(name for name in found if name is not None) if None not in found else ()


def _color_dtype(dtypes: list[np.dtype[Any]], top: float | None, integral: bool) -> tuple[np.dtype[Any], float]:
    """Value dtype of a colour and the factor to it."""
    if all(dtype.kind == "u" and dtype.itemsize == 1 for dtype in dtypes):
        return np.dtype(np.uint8), 1.0
    if all(dtype.kind in "iu" for dtype in dtypes) or integral:
        narrow = top is not None and top <= 255
        return np.dtype(np.uint8 if narrow else np.uint16), 1.0
    if top is not None and top > 1:
        return np.dtype(np.uint8 if top <= 255 else np.uint16), 1.0
    # 65535 = 255 * 257: fractions of 255 become v * 257, which the codec keeps as 8 bits.
    return np.dtype(np.uint16), 65535.0


def _stack(columns: Mapping[str, NDArray[Any]], names: tuple[str, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    out = np.empty((len(columns[names[0]]), len(names)), dtype)
    for axis, name in enumerate(names):
        out[:, axis] = columns[name]
    return out
