"""Colours of samples by what they carry: a stage between the access layer and a renderer.

A renderer draws the attribute ``color``. `Colouring` gives it a header and clouds in which that attribute holds the
colours of a mode, so that no renderer knows of modes. Pure: equal clouds give equal colours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from lpc.attributes import Attribute
from lpc.octahedral import decode_normals

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.header import Header
    from lpc.index import IndexTree

Mode = Literal["color", "shading", "height", "intensity", "classification", "normal", "level"]
MODES: tuple[Mode, ...] = get_args(Mode)

Rgb = tuple[int, int, int]

RAMP_STOPS: tuple[Rgb, ...] = (
    (38, 28, 92),
    (36, 92, 158),
    (28, 152, 140),
    (112, 190, 78),
    (236, 206, 64),
    (240, 120, 44),
)
"""Dark blue to orange: lightness rises up to the last but one, so that it reads without hue too."""

CLASSES: dict[int, tuple[str, Rgb]] = {
    0: ("never classified", (150, 150, 150)),
    1: ("unclassified", (190, 190, 190)),
    2: ("ground", (166, 124, 82)),
    3: ("low vegetation", (158, 201, 92)),
    4: ("medium vegetation", (92, 168, 66)),
    5: ("high vegetation", (34, 118, 50)),
    6: ("building", (214, 96, 68)),
    7: ("low noise", (226, 74, 180)),
    8: ("key point", (240, 240, 240)),
    9: ("water", (66, 132, 214)),
    10: ("rail", (120, 96, 150)),
    11: ("road surface", (110, 112, 122)),
    12: ("overlap", (232, 186, 110)),
    13: ("wire, guard", (246, 214, 80)),
    14: ("wire, conductor", (250, 168, 40)),
    15: ("transmission tower", (90, 200, 210)),
    16: ("wire connector", (200, 150, 240)),
    17: ("bridge deck", (170, 150, 130)),
    18: ("high noise", (190, 40, 140)),
}
"""Names of ASPRS LAS 1.4, table 17."""

WHEEL: tuple[Rgb, ...] = (
    (228, 88, 78),
    (240, 164, 60),
    (222, 212, 84),
    (110, 190, 96),
    (66, 180, 190),
    (84, 124, 220),
    (170, 104, 206),
)
"""For whole numbers without names of their own."""

TAILS = (1.0, 99.0)
"""Percentiles of the root's samples that the ramp of an intensity spans: single mirrors do not darken all the rest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Legend:
    """What the colours mean.

    Parameters
    ----------
    title : str
    ramp : (256, 3) uint8, or None
        Colours from `low` to `high`.
    entries : tuple of (text, colour)
        Colours with a meaning each.
    """

    title: str
    ramp: NDArray[np.uint8] | None = None
    low: float = 0.0
    high: float = 0.0
    entries: tuple[tuple[str, Rgb], ...] = ()


def available_modes(header: Header) -> tuple[Mode, ...]:
    """Modes that a model has the attributes for."""
    names = {attribute.name for attribute in header.attributes}
    kinds = {attribute.kind for attribute in header.attributes}
    needs: dict[Mode, bool] = {
        "color": "color" in kinds,
        "intensity": "intensity" in names,
        "classification": "classification" in names,
        "normal": "normal" in kinds,
    }
    return tuple(mode for mode in MODES if needs.get(mode, True))


class Colouring:
    """One mode of one model.

    Parameters
    ----------
    root : Cloud, optional
        The root's cloud: a uniform sample of the whole model, whose values span the ramp of an intensity.
    index : IndexTree
        Tells the levels of nodes.
    up : {0, 1, 2}, optional
        The axis of heights; z where the model is georeferenced, else y.

    Attributes
    ----------
    header : Header
        What a renderer is opened with.
    legend : Legend or None
        Names the classes of the clouds that were coloured so far.
    """

    def __init__(
        self, mode: Mode, header: Header, index: IndexTree, root: Cloud | None, *, up: int | None = None
    ) -> None:
        self.mode = mode
        self._up = (2 if header.crs is not None else 1) if up is None else up
        self._classes = np.zeros(256, dtype=bool)
        self.legend: Legend | None = None
        self.header = header
        self._index, self._model = index, header
        self._attribute = next((each for each in header.attributes if each.name == mode or each.kind == mode), None)
        if mode == "color":
            return
        attributes = tuple(attribute for attribute in header.attributes if attribute.kind != "color")
        constants = {name: constant for name, constant in header.constants.items() if name != "color"}
        if mode != "shading":
            name = "color" if all(attribute.name != "color" for attribute in attributes) else "shown color"
            self._shown = Attribute(name=name, kind="color", dtype="|u1", bits=8)
            attributes = (*attributes, self._shown)
        self.header = replace(header, attributes=attributes, constants=constants)
        self._table, self._low, self._high = ramp(), 0.0, 1.0
        self._prepare(root)

    def cloud(self, node: int, cloud: Cloud) -> Cloud:
        """Give a cloud the colours of the mode."""
        if self.mode in ("color", "shading"):
            return cloud
        return replace(cloud, codes={**cloud.codes, self._shown.name: self.colors(node, cloud)})

    def colors(self, node: int, cloud: Cloud) -> NDArray[np.uint8]:
        """Colours of a cloud's samples, (k, 3) uint8."""
        if self.mode == "level":
            return np.tile(self._table[int(self._index.level[node]) % len(self._table)], (len(cloud), 1))
        if self.mode == "height":
            return self._ramped(self._heights(cloud))
        attribute = self._attribute
        if attribute is None or attribute.name not in cloud.codes:
            return np.full((len(cloud), 3), 128, dtype=np.uint8)
        codes = cloud.codes[attribute.name]
        if self.mode == "normal":
            return np.rint(decode_normals(codes, attribute.bits) * 127.0 + 128.0).astype(np.uint8)
        values = attribute.decode(codes)
        if self.mode == "classification":
            numbers = np.clip(values, 0, 255).astype(np.uint8)
            self._note(numbers)
            return self._table[numbers]
        return self._ramped(values.astype(np.float64))

    def _prepare(self, root: Cloud | None) -> None:
        """Set range, table and legend of the mode."""
        if self.mode == "level":
            self._table = np.array(WHEEL, dtype=np.uint8)
            levels = range(min(self._model.levels, len(WHEEL)))
            names = [", ".join(map(str, range(level, self._model.levels, len(WHEEL)))) for level in levels]
            self.legend = Legend(title="level of the tree", entries=tuple(zip(names, WHEEL, strict=False)))
        elif self.mode == "height":
            axis = self._up
            self._low, self._high = self._model.bounds[axis], self._model.bounds[axis + 3]
            self.legend = Legend(title=f"height ({'xyz'[axis]})", ramp=self._table, low=self._low, high=self._high)
        elif self.mode == "classification":
            self._table = class_table()
            self.legend = Legend(title="classification")
            if root is not None:
                self.colors(0, root)
        elif self.mode == "intensity" and self._attribute is not None:
            if root is not None and len(root):
                values = self._attribute.decode(root.codes[self._attribute.name]).astype(np.float64)
                self._low, self._high = np.nanpercentile(values, TAILS).tolist()
            self.legend = Legend(title="intensity", ramp=self._table, low=self._low, high=self._high)
        elif self.mode == "normal":
            shares = (("+x", (255, 128, 128)), ("+y", (128, 255, 128)), ("+z", (128, 128, 255)))
            self.legend = Legend(title="normal", entries=shares)

    def _note(self, numbers: NDArray[np.uint8]) -> None:
        """Name the classes of a cloud in the legend."""
        here = np.bincount(numbers, minlength=256) > 0
        if (here <= self._classes).all():
            return
        self._classes |= here
        found = np.flatnonzero(self._classes).tolist()
        entries = tuple((f"{number} {class_name(number)}", _rgb(self._table[number])) for number in found)
        self.legend = Legend(title="classification", entries=entries)

    def _heights(self, cloud: Cloud) -> NDArray[np.float64]:
        axis = self._up
        lattice = (cloud.position[:, axis].astype(np.int64) << cloud.shift) + cloud.origin[axis]
        return self._model.origin[axis] + self._model.step * lattice

    def _ramped(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        span = self._high - self._low
        place = (values - self._low) / span if span > 0 else np.full(len(values), 0.5)
        with np.errstate(invalid="ignore"):
            place = np.nan_to_num(np.clip(place, 0.0, 1.0))
        return self._table[np.rint(place * 255).astype(np.uint8)]


def ramp() -> NDArray[np.uint8]:
    """Return the 256 colours of a value from low to high, (256, 3) uint8."""
    stops = np.array(RAMP_STOPS, dtype=np.float64)
    at = np.linspace(0, len(stops) - 1, 256)
    channels = [np.interp(at, np.arange(len(stops)), stops[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def class_name(number: int) -> str:
    """Name of a class; LAS leaves 64 to 255 to its users."""
    return CLASSES[number][0] if number in CLASSES else "reserved" if number < 64 else "user defined"


def class_table() -> NDArray[np.uint8]:
    """Colour of every class, (256, 3) uint8."""
    table = np.array([WHEEL[number % len(WHEEL)] for number in range(256)], dtype=np.uint8)
    for number, (_, color) in CLASSES.items():
        table[number] = color
    return table


def _rgb(color: NDArray[np.uint8]) -> Rgb:
    return int(color[0]), int(color[1]), int(color[2])
