"""Text of numbers: XYZ, PTS, CSV, TXT, ASC, with or without a header line.

Columns are parted by any run of blanks, tabs, commas or semicolons (where semicolons part them, commas are decimal
points). Their meaning comes from a header line that names them, else from their number and their values: three are
positions, then single columns are intensities, triples of unit vectors normals and triples of whole numbers colours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpc.errors import ScanError
from lpc.points import PointBatch

from .columns import ColumnPlan, plain_name, plan_columns
from .lines import Lines, table
from .scan import CUT_SHORT, ReadOptions, ScanInfo

_HEAD = 1 << 16
_PROBES = 16
_MOST_HEADER_LINES = 100
_COMMENTS = (b"#", b"//", b"%", b"!")
_BLANKS = bytes.maketrans(b',;\t"', b"    ")
_DECIMAL_COMMAS = bytes.maketrans(b',;\t"', b".   ")


@dataclass(frozen=True, slots=True, kw_only=True)
class TextLayout:
    """How the lines of one file read.

    Parameters
    ----------
    skip : int
        Lines before the first line of numbers.
    blanks : bytes
        Table that turns everything between numbers into blanks, and decimal commas into points.
    names : tuple of str or None
        Column names of the header line.
    sample : ndarray, (rows, columns) float64
        Some rows from all over the file.
    counted : bool
        A line with nothing but a number of samples comes before them, as in PTS files.
    """

    skip: int
    blanks: bytes
    names: tuple[str, ...] | None
    sample: NDArray[np.float64]
    counted: bool


class TextScan:
    """One text file.

    Intensities are float32 and other scalars float64, so that no late row can be out of range. Colours are uint8,
    or uint16 if any probed row is beyond 255.

    Parameters
    ----------
    path : Path
        The file.
    options : ReadOptions
        What to take.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self._layout = read_layout(path)
        names = list(self._layout.names or ())
        if not {"x", "y", "z"} <= _known(names, options):
            names = _guess(self._layout.sample)
        self._names = names
        dtypes = {name: np.dtype(np.float64) for name in names}
        colors = [k for k, name in enumerate(names) if plain_name(name) in ("red", "green", "blue", "r", "g", "b")]
        shades = self._layout.sample[:, colors] if colors else np.zeros((1, 1))
        shades = shades[np.isfinite(shades)]
        self._plan = _narrow(
            plan_columns(
                dtypes,
                options,
                color_top=float(shades.max(initial=0)),
                # one is white only if there are fractions below it
                color_integral=bool((shades == np.rint(shades)).all()) and shades.max(initial=0) != 1,
            )
        )
        self.info = ScanInfo(
            path=path,
            attributes=self._plan.dtypes,
            raw_bytes=path.stat().st_size,
            left_out=self._plan.left_out,
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples; see `Scan.batches`."""
        declared = found = 0
        with self.info.path.open("rb") as file:
            lines = Lines(file)
            for _ in range(self._layout.skip):
                lines.take(1)
            while True:
                line = lines.line
                text = lines.take(size)
                if not text:
                    break
                try:
                    values = table(text.translate(self._layout.blanks))
                    if len(values) and values.shape[1] != len(self._names):
                        raise ValueError("another number of columns")
                except ValueError:
                    values, counts = self._line_by_line(text, line)
                    declared += counts
                if len(values):
                    yield self._plan.batch({name: values[:, k] for k, name in enumerate(self._names)})
                found += len(values)
        if declared > found:
            raise ScanError(f"{self.info.path}: declares {declared:,} samples, holds {found:,}; {CUT_SHORT}")

    def _line_by_line(self, text: bytes, line: int) -> tuple[NDArray[np.float64], int]:
        """Read a block that is no plain table: comments, and the counts between the scans of PTS files, are allowed."""
        rows: list[list[float]] = []
        declared = 0
        for number, raw in enumerate(text.split(b"\n"), start=line):
            words = raw.translate(self._layout.blanks).split()
            if not words or raw.lstrip().startswith(_COMMENTS):
                continue
            try:
                row = [float(word) for word in words]
            except ValueError:
                row = []
            if self._layout.counted and len(row) == 1 and row[0].is_integer():
                declared += int(row[0])
            elif len(row) == len(self._names):
                rows.append(row)
            else:
                what = f"{len(row)} numbers, not {len(self._names)}" if row else f"{raw[:40]!r} is no line of numbers"
                raise ScanError(f"{self.info.path}, line {number:,}: {what}; mend the line or remove it")
        return np.array(rows, dtype=np.float64).reshape(len(rows), len(self._names)), declared


def read_layout(path: Path) -> TextLayout:
    """Look at the head of a file and at some places further on.

    Raises
    ------
    ScanError
        If no line of at least three numbers comes within the first lines.
    """
    names: tuple[str, ...] | None = None
    counted = False
    with path.open("rb") as file:
        head = file.read(_HEAD).removeprefix(b"\xef\xbb\xbf")
        head = head if b"\n" in head else head.replace(b"\r", b"\n")
        lines = head.split(b"\n")
        for skip, raw in enumerate(lines[:_MOST_HEADER_LINES]):
            blanks = _DECIMAL_COMMAS if re.search(rb"\d,\d[^;]*;", raw) else _BLANKS
            words = raw.translate(blanks).split()
            comment = raw.lstrip().startswith(_COMMENTS)
            if not comment and len(words) >= 3 and all(_is_number(word) for word in words):
                sample = _sample(path, blanks, len(words), lines[skip:])
                if names is not None and len(names) != len(words):
                    names = None
                return TextLayout(skip=skip - counted, blanks=blanks, names=names, sample=sample, counted=counted)
            counted = not comment and len(words) == 1 and words[0].isdigit()
            names = _header_names(raw) or (names if comment or counted or not words else None)
    raise ScanError(f"{path}: no line of three or more numbers near its start; nothing in it is a sample")


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _header_names(raw: bytes) -> tuple[str, ...] | None:
    text = raw.decode("utf-8", "replace").strip().lstrip("#/%!").strip()
    parted = re.split(r"[,;\t]", text) if re.search(r"[,;\t]", text) else text.split()
    names = tuple(plain_name(name) for name in parted if name.strip())
    return names if len(names) >= 3 and len(set(names)) == len(names) else None


def _sample(path: Path, blanks: bytes, columns: int, head: list[bytes]) -> NDArray[np.float64]:
    """Rows of the head and of places all over the file, those that read as `columns` numbers."""
    length = path.stat().st_size
    lines = head[: -1 if length > _HEAD else None][:500]
    with path.open("rb") as file:
        for probe in range(1, _PROBES if length > _HEAD else 0):
            file.seek(length * probe // _PROBES)
            lines += file.read(_HEAD // 8).split(b"\n")[1:-1]
    rows = [words for line in lines if len(words := line.translate(blanks).split()) == columns]
    return np.array([[float(w) for w in words] for words in rows if all(_is_number(w) for w in words)])


def _known(names: list[str], options: ReadOptions) -> set[str]:
    """Which of x, y, z the names hold."""
    try:
        return {"x", "y", "z"} if plan_columns({n: np.dtype(np.float64) for n in names}, options) else set()
    except ScanError:
        return set()


def _guess(sample: NDArray[np.float64]) -> list[str]:
    """Name columns by their number and values."""
    columns = sample.shape[1]
    names = ["x", "y", "z"]
    while len(names) < columns:
        k = len(names)
        triple = sample[:, k : k + 3]
        if (columns - k) % 3 == 0 and "nx" not in names and _are_unit(triple):
            names += ["nx", "ny", "nz"]
        elif (columns - k) % 3 == 0 and "red" not in names and _are_colors(triple):
            names += ["red", "green", "blue"]
        elif k == 3 and (columns - k) % 3:
            names.append("intensity")
        else:
            names.append(f"column_{k + 1}")
    return names


def _are_unit(triple: NDArray[np.float64]) -> bool:
    length = np.linalg.norm(triple, axis=1)
    length = length[np.isfinite(length) & (length > 0)]
    return len(length) > 0 and float((np.abs(length - 1) < 0.02).mean()) > 0.9


def _are_colors(triple: NDArray[np.float64]) -> bool:
    triple = triple[np.isfinite(triple).all(axis=1)]
    if not len(triple) or triple.min() < 0:
        return False
    whole = bool((triple == np.rint(triple)).all())
    return bool(triple.max() <= (65535 if whole else 1))


def _narrow(plan: ColumnPlan) -> ColumnPlan:
    """Keep intensities as float32."""
    small: dict[str, np.dtype[Any]] = {"intensity": np.dtype(np.float32)}
    dtypes = {name: small.get(name, dtype) for name, dtype in plan.dtypes.items()}
    return ColumnPlan(
        position=plan.position, normal=plan.normal, color=plan.color, color_scale=plan.color_scale,
        scalars=plan.scalars, dtypes=dtypes, left_out=plan.left_out,
    )  # fmt: skip
