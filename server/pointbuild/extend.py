"""Adding scans to a model: its samples once more as a scan, and its clouds for those that do not change.

A model is made of the lattice points and codes of its samples (`frame`), so what is decoded from it serves as well as
what it was built of: the model of these samples and of others is, byte for byte, the one that all scans together give
on the same lattice. Each of its samples brings the number of the cloud it was in. A cloud of the new model whose
samples are all those of one old cloud, and no others, is that cloud, and its bytes are copied if its nearest ancestors,
from which they are guessed (`lpc.context`), did not change either.
"""

from __future__ import annotations

import os
import zlib
from collections import ChainMap
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.codec import decode_cloud, samples_to_points
from lpc.context import ANCESTORS, is_told, line_of
from lpc.errors import BuildError, FormatError
from lpc.header import HEADER_PROBE, PART_SUFFIX, parse_header
from lpc.index import IndexTree
from lpc.points import PointBatch

from .readers import ScanInfo
from .readers.scan import DEFAULT_ATTRIBUTES
from .work import in_order

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.header import Header

    from .frame import Frame
    from .inputs import Inputs
    from .options import BuildOptions
    from .survey import Survey

    Clouds = dict[int, Cloud]

OWNER = "\0cloud"
"""Name of the column that says which cloud of the old model a sample was in, counted from 1; 0: it is new."""

DECODERS = 2
"""Threads that decode the old model."""

PACKING = "packing"
"""Header key: the options of a build that only its bytes would tell, and that an append needs."""


def packing_of(options: BuildOptions) -> dict[str, Any]:
    """Value of the header's `PACKING`."""
    return {"effort": options.effort, "color_bits": options.color_bits}


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn what is wrong with a file into a sentence about it."""
    try:
        yield
    except FormatError as error:
        raise BuildError(f"{path} cannot be added to: {error}") from error
    except OSError as error:
        raise BuildError(f"{path}: {error.strerror or error}; name a model that can be read") from error


@dataclass(frozen=True, slots=True)
class OldModel:
    """A model that scans are added to.

    Parameters
    ----------
    path : Path
    header : Header
    index : IndexTree
        Whole.
    """

    path: Path
    header: Header
    index: IndexTree

    @classmethod
    def open(cls, path: Path) -> OldModel:
        """Read the header and the index.

        Raises
        ------
        BuildError
            If there is no such model, it is damaged, or it was built by a program that could not add to it.
        """
        header = read_header(path)
        start = np.rint(np.array(header.origin) / header.step)
        if PACKING not in header.extra or (start * header.step != header.origin).any():
            raise BuildError(
                f"{path} was built before models could be added to: build it anew of its scans and the others"
            )
        with _told(path), path.open("rb") as file:
            whole = os.fstat(file.fileno()).st_size == header.bytes
            if not whole or path.with_name(path.name + PART_SUFFIX).exists():
                raise BuildError(f"{path} is not whole: it should have {header.bytes:,} bytes; fetch or copy it again")
            index = IndexTree(header)
            for page in range(header.pages):
                where = index.page_range(page)
                file.seek(where.start)
                index.add_page(page, file.read(where.stop - where.start))
        return cls(path, header, index)

    @property
    def info(self) -> ScanInfo:
        """The model as a scan."""
        header = self.header
        attributes = {entry.name: np.dtype(entry.dtype) for entry in header.attributes}
        for name, constant in header.constants.items():
            attributes[name] = np.dtype(constant.dtype)
        return ScanInfo(
            path=self.path,
            samples_hint=header.samples,
            bounds_hint=header.bounds,
            crs=header.crs,
            attributes=attributes,
            raw_bytes=header.bytes,
            left_out=dict(header.left_out),
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Yield all samples, subtree by subtree, with `OWNER`.

        A decoded position may lie half a step outside the box of the input; it is given on the box, which is nearest to
        the same lattice point.
        """
        size = max(size // (DECODERS + 2), 1)  # so many subtrees are here at a time
        # Decoding takes longer than everything else that reads a scan.
        with ThreadPoolExecutor(DECODERS, thread_name_prefix="decode") as pool, self.path.open("rb") as file:
            parts = self._parts(size, file.fileno())
            for _, batch in in_order(lambda part: pool.submit(self._batch, *part, file.fileno()), parts, DECODERS):
                yield batch

    def _parts(self, size: int, file: int) -> Iterator[tuple[list[int], Clouds]]:
        """Cut the tree into subtrees of at most `size` samples and single nodes above them.

        Each comes with the clouds that it is told from; a node above comes decoded, since those below it need it.
        """
        todo: list[tuple[int, Clouds]] = [(0, {})]
        while todo:
            node, line = todo.pop()
            if self.index.subtree[node] <= size:
                yield self._below(node), line
            else:
                known = line | self._decoded([node], line, file)
                yield [node], known
                line = dict(list(known.items())[-ANCESTORS:])
                todo += [(child, line) for child in self.index.children[node].tolist() if child >= 0]

    def _below(self, node: int) -> list[int]:
        """Give a node and its descendants, parents first."""
        level, found = np.array([node]), []
        while len(level):
            found.append(level)
            level = self.index.children[level].ravel()
            level = level[level >= 0]
        return np.concatenate(found).tolist()

    def _batch(self, nodes: list[int], known: Clouds, file: int) -> PointBatch:
        """Give the samples of some nodes; `known` are their ancestors that are not among them."""
        header, decoded = self.header, self._decoded(nodes, known, file)
        clouds = [decoded[node] for node in nodes]
        codes = {
            entry.name: np.concatenate([cloud.codes[entry.name] for cloud in clouds]) for entry in header.attributes
        }
        points = samples_to_points(np.concatenate([cloud.lattice() for cloud in clouds]), codes, header)
        xyz = np.clip(points.xyz, header.bounds[:3], header.bounds[3:])
        owner = np.repeat(np.array(nodes, np.uint32) + np.uint32(1), self.index.samples[nodes])
        return PointBatch(xyz, {**points.attributes, OWNER: owner})

    def _decoded(self, nodes: list[int], known: Clouds, file: int) -> Clouds:
        """Decode nodes, parents first, but for those that are known."""
        found = {node: known[node] for node in nodes if node in known}
        schema, clouds = self.header.attributes, ChainMap(found, known)
        with _told(self.path):
            for node in nodes:
                if node not in found:
                    frame, samples = self.frame(file, node), int(self.index.samples[node])
                    context = [clouds[above] for above in self.line(node)]
                    found[node] = decode_cloud(frame, samples=samples, schema=schema, context=context)
        return found

    def line(self, node: int) -> list[int]:
        """Nodes that tell a cloud, from the root down."""
        return line_of(node, self.index.parent) if is_told(self.header) else []

    def frame(self, file: int, node: int) -> bytes:
        """Bytes of a cloud, checked."""
        where = self.index.cloud_range(node)
        data = os.pread(file, where.stop - where.start, where.start)
        if zlib.crc32(data) != int(self.index.crc[node]):
            raise BuildError(f"cloud {node} of {self.path} is damaged: `pointstream verify` says what else is")
        return data

    def options(self, options: BuildOptions) -> BuildOptions:
        """Give those of a build that adds to this model: what the model is made by is kept."""
        header = self.header
        normal = next((entry.bits for entry in header.attributes if entry.kind == "normal"), options.normal_bits)
        return replace(
            options,
            cloud_size=header.cloud_size,
            step=header.step,
            position_error=None,
            seed=header.seed,
            page_nodes=header.page_nodes,
            normal_bits=normal,
            attributes=None if self.info.attributes.keys() <= set(DEFAULT_ATTRIBUTES) else ("all",),
            **header.extra[PACKING],
        )

    def join(self, inputs: Inputs) -> Inputs:
        """Put the model before the scans that are added to it.

        Raises
        ------
        BuildError
            If a scan has other attributes or another coordinate system.
        """
        mine = self.info
        for scan in inputs.scans:
            for name in mine.attributes.keys() | scan.info.attributes.keys():
                if name not in scan.info.attributes:
                    raise BuildError(
                        f"{scan.info.path} has no attribute {name!r}, and all samples of {self.path} have one: build "
                        "them anew together, which leaves it out"
                    )
                if name not in mine.attributes and name not in mine.left_out:
                    raise BuildError(
                        f"{scan.info.path} has an attribute {name!r} that {self.path} lacks: take it out of the scan"
                    )
                if name in mine.attributes and mine.attributes[name] != scan.info.attributes[name]:
                    raise BuildError(
                        f"{name!r} is {scan.info.attributes[name]} in {scan.info.path} and {mine.attributes[name]} in "
                        f"{self.path}: convert the scan"
                    )
        if inputs.crs != mine.crs:
            said = "says none" if inputs.crs is None else "is in another one"
            raise BuildError(
                f"{self.path} and {inputs.scans[0].info.path} have different coordinate systems (the scan {said}): "
                "bring the scan into that of the model"
            )
        return replace(
            inputs,
            scans=(self, *inputs.scans),
            attributes={name: np.dtype(dtype) for name, dtype in mine.attributes.items()},
            left_out={**inputs.left_out, **mine.left_out},
        )

    def join_survey(self, found: Survey) -> Survey:
        """Add what the model says of its own samples as they came.

        Raises
        ------
        BuildError
            If colours that the model has shortened would be shortened otherwise.
        """
        header = self.header
        for entry in header.attributes:
            if entry.depth and entry not in found.schema:
                raise BuildError(
                    f"the colours of {self.path} have {entry.bits} bits of {entry.depth}, and those of the scans "
                    "cannot be shortened in the same way: build all anew together"
                )
        rejected = dict(header.rejected)
        for reason, count in found.rejected.items():
            rejected[reason] = rejected.get(reason, 0) + count
        return replace(
            found,
            low=np.minimum(found.low, header.bounds[:3]),
            high=np.maximum(found.high, header.bounds[3:]),
            rejected=rejected,
        )

    def clouds(self, found: Survey, frame: Frame, options: BuildOptions, generator: str) -> OldClouds | None:
        """Clouds that may stay as they are; None if every cloud changes: with the origin, or what codes mean."""
        header = self.header
        same = (
            tuple(frame.origin.tolist()) == header.origin
            and found.schema == header.attributes
            and header.generator == generator
            and header.extra[PACKING] == packing_of(options)
        )
        return OldClouds(self) if same else None


@dataclass(frozen=True, slots=True)
class OldClouds:
    """The clouds of the old model, for the new one.

    Parameters
    ----------
    model : OldModel
    """

    model: OldModel

    def find(self, owner: NDArray[np.uint32], bounds: NDArray[np.int64]) -> NDArray[np.int64]:
        """Old cloud that has the samples of each cloud, and no others; -1: none.

        Parameters
        ----------
        owner : ndarray, (n,) uint32
            `OWNER` of all samples.
        bounds : ndarray, (k + 1,) int64
            Cloud i is the samples ``bounds[i]`` to ``bounds[i + 1]``.
        """
        starts = bounds[:-1]
        number = owner[starts].astype(np.int64) - 1
        one = np.minimum.reduceat(owner, starts) == np.maximum.reduceat(owner, starts)
        return np.where(one & (number >= 0) & (self.model.index.samples[number] == np.diff(bounds)), number, -1)

    def stays(self, number: int, line: list[int]) -> bool:
        """Whether a cloud that is old cloud `number`, and whose ancestors are those of `line`, has the same bytes."""
        return number >= 0 and self.model.line(number) == line

    def frame(self, number: int) -> bytes:
        """Bytes of an old cloud."""
        file = os.open(self.model.path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return self.model.frame(file, number)
        finally:
            os.close(file)


def read_header(path: Path) -> Header:
    """Header of a model.

    Raises
    ------
    BuildError
        If there is none.
    """
    with _told(path), path.open("rb") as file:
        return parse_header(file.read(HEADER_PROBE))
