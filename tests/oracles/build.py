"""An in-memory builder by plain recursion: slow, obvious, and complete.

It follows *Layered Point Clouds*, sections 3 and 5, word by word and loops over nodes and samples in Python. The
real builder must agree with it in everything that the format fixes; it samples by another rule, so the clouds differ.
"""

from __future__ import annotations

import math
import zlib
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.attributes import Attribute, Schema
from lpc.codec import decode_cloud, encode_cloud
from lpc.header import Header, seal
from lpc.lattice import position_error_bound, position_step, quantise
from lpc.octahedral import decode_normals, encode_normals
from lpc.page import NO_CONE, RECORD, pack_pages

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.points import PointBatch


@dataclass(slots=True)
class Node:
    """A node: `own` are its samples, `all` those of its subtree (positions in the input)."""

    own: NDArray[np.int64]
    all: NDArray[np.int64]
    children: list[Node | None] = field(default_factory=lambda: [None, None])
    spacing: float = 0.0
    drawn: float = 0.0  # M_tot of equation 1


def build_bytes(
    points: PointBatch,
    *,
    cloud_size: int = 256,
    page_nodes: int = 16,
    seed: int = 0,
    step: float | None = None,
    spacing: float | None = None,
    normal_bits: int = 8,
    crs: str | None = None,
) -> bytes:
    """Build the .lpc file of some samples.

    Parameters
    ----------
    points : PointBatch
        ``normal``, ``color`` and integer or float scalars are kept.
    cloud_size : int
        M.
    page_nodes : int
        Records per page.
    seed : int
        Of the subsampling.
    step : float, optional
        Lattice cell; from the spacing if not given.
    spacing : float, optional
        r; the square root of the box's surface over the samples if not given.
    """
    xyz = points.xyz
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    extent = float((high - low).max())
    if spacing is None:
        x, y, z = high - low
        spacing = math.sqrt(2 * (x * y + y * z + z * x) / len(points))
    if step is None:
        step = position_step(spacing, extent)
    schema, codes = encode_attributes(points, normal_bits)
    nodes = breadth_first(partition(xyz, cloud_size, np.random.default_rng(seed)))
    assign_spacings(nodes, spacing)

    error = position_error_bound(step, low, extent)
    side = extent * (1 + 2.0**-20) or 1.0
    lattice = quantise(xyz, low, step)
    records = np.zeros(len(nodes), RECORD)
    clouds = []
    lines: dict[int, list[Cloud]] = {id(nodes[0]): []}  # decoded ancestors of each node, from the root down
    for record, node in zip(records, nodes, strict=True):
        own, context = {name: values[node.own] for name, values in codes.items()}, lines[id(node)]
        cloud = encode_cloud(lattice[node.own], own, schema, context=context)
        decoded = decode_cloud(cloud, samples=len(node.own), schema=schema, context=context)
        lines |= {id(child): [*context, decoded] for child in node.children if child is not None}
        clouds.append(cloud)
        record["size"], record["crc"] = len(cloud), zlib.crc32(cloud)
        record["samples"], record["subtree"], record["spacing"] = len(node.own), len(node.all), node.spacing
        record["children"] = sum(1 << bit for bit in (0, 1) if node.children[bit] is not None)
        write_sphere(record, xyz[node.all], low, side, error)
        write_cone(record, points.normal, codes, node, normal_bits)

    header = Header(
        bytes=2**53,
        samples=len(points),
        nodes=len(nodes),
        levels=depth(nodes[0]),
        cloud_size=cloud_size,
        page_nodes=page_nodes,
        origin=(float(low[0]), float(low[1]), float(low[2])),
        step=step,
        side=side,
        bounds=(*map(float, low), *map(float, high)),  # type: ignore[arg-type]
        spacing=spacing,
        position_error=error,
        attributes=schema,
        crs=crs,
        seed=seed,
        generator="pointstream test oracle",
    )
    header = seal_with_total(header, records)
    parts = [header.to_bytes()]
    for number, (_, page) in enumerate(pack_pages(header.tag, records, page_nodes, header.page0)):
        parts += [page, *clouds[number * page_nodes : (number + 1) * page_nodes]]
    return b"".join(parts)


def seal_with_total(header: Header, records: NDArray[Any]) -> Header:
    """A header that states what its own file costs a sample; spaces in `generator` help where no length does."""
    for _ in range(16):
        sealed = seal(header, records)
        for _ in range(8):
            total = 8 * sealed.bytes / header.samples
            if sealed.bits_per_sample == {"total": total}:
                return sealed
            sealed = seal(replace(header, bits_per_sample={"total": total}), records)
        header = replace(header, generator=header.generator + " ")
    raise AssertionError("no length of the file states itself")


def partition(xyz: NDArray[np.float64], cloud_size: int, rng: np.random.Generator) -> Node:
    """LPC 5, recursive partitioning."""

    def split(which: NDArray[np.int64], low: NDArray[np.float64], high: NDArray[np.float64]) -> Node:
        coincide = (xyz[which] == xyz[which[0]]).all()
        if len(which) <= cloud_size or coincide:
            return Node(own=which, all=which)
        own = np.sort(rng.choice(which, cloud_size, replace=False))
        rest = np.setdiff1d(which, own)
        axis = int(np.argmax(high - low))
        middle = low[axis] + (high[axis] - low[axis]) / 2
        above = xyz[rest, axis] >= middle
        node = Node(own=own, all=which)
        for side, part in enumerate((rest[~above], rest[above])):
            if len(part):
                child_low, child_high = low.copy(), high.copy()
                (child_high if side == 0 else child_low)[axis] = middle
                node.children[side] = split(part, child_low, child_high)
        return node

    return split(np.arange(len(xyz)), xyz.min(axis=0), xyz.max(axis=0))


def breadth_first(root: Node) -> list[Node]:
    """All nodes by level and, inside a level, in the order of their parents: the numbering of docs/format.md."""
    order, queue = [], deque([root])
    while queue:
        node = queue.popleft()
        order.append(node)
        queue.extend(child for child in node.children if child is not None)
    return order


def depth(node: Node) -> int:
    """Levels of a subtree."""
    return 1 + max((depth(child) for child in node.children if child is not None), default=0)


def assign_spacings(nodes: list[Node], r: float) -> None:
    """LPC 3, equations 1 and 2."""
    root = nodes[0]
    root.drawn, root.spacing = len(root.own), r * math.sqrt(len(root.all) / len(root.own))
    for parent in nodes:
        for child in parent.children:
            if child is not None:
                share = len(child.all) / (len(parent.all) - len(parent.own))
                child.drawn = share * parent.drawn + len(child.own)
                child.spacing = parent.spacing * math.sqrt(share * parent.drawn / child.drawn)


def encode_attributes(points: PointBatch, normal_bits: int) -> tuple[Schema, dict[str, NDArray[Any]]]:
    """The schema that fits the values, and their codes."""
    schema, codes = [], {}
    for name, values in points.attributes.items():
        item = values.dtype.newbyteorder("<")
        if name == "normal":
            attribute = Attribute(name=name, kind="normal", dtype="<f4", bits=normal_bits)
            codes[name] = encode_normals(values, normal_bits)
        elif name == "color":
            attribute = Attribute(name=name, kind="color", dtype=item.str, bits=8 * item.itemsize)
            codes[name] = attribute.encode(values)
        else:
            kind = Attribute(name=name, kind="scalar", dtype=item.str, bits=8 * item.itemsize)
            offset = 0 if item.kind == "f" else int(values.min())
            bits = kind.bits if item.kind == "f" else max(1, (int(values.max()) - offset).bit_length())
            attribute = Attribute(name=name, kind="scalar", dtype=item.str, bits=bits, offset=offset)
            codes[name] = attribute.encode(values)
        schema.append(attribute)
    return tuple(schema), codes


def write_sphere(record: Any, xyz: NDArray[np.float64], low: NDArray[np.float64], side: float, error: float) -> None:
    """A sphere around a subtree's samples about the centre of their box, exact for the centre as it is stored."""
    center = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    codes = np.clip(np.round((center - low) / side * 2.0**32), 0, 2**32 - 1)
    stored = low + codes * side / 2.0**32
    radius = max(math.dist(stored, sample) for sample in xyz) + 2 * error
    record["center"] = codes.astype(np.uint32)
    record["radius"] = np.nextafter(np.float32(radius * (1 + 1e-12)), np.float32(np.inf))


def write_cone(
    record: Any, normals: NDArray[np.float32] | None, codes: dict[str, NDArray[Any]], node: Node, bits: int
) -> None:
    """A cone around a subtree's normals, given and decoded ones, about the axis as it is stored."""
    record["cone_angle"] = NO_CONE
    if normals is None:
        return
    both = np.concatenate([normals[node.all], decode_normals(codes["normal"][node.all], bits)]).astype(np.float64)
    lengths = np.linalg.norm(both, axis=1)
    mean = both.sum(axis=0)
    if lengths.min() == 0 or np.linalg.norm(mean) < 1e-6 * len(both):
        return
    axis = encode_normals((mean / np.linalg.norm(mean))[None].astype(np.float32), 8)
    stored = decode_normals(axis, 8)[0].astype(np.float64)
    stored /= np.linalg.norm(stored)
    widest = max(math.acos(max(-1.0, min(1.0, float(cosine)))) for cosine in both @ stored / lengths)
    units = math.ceil((widest + 1e-6) / math.pi * 65534)
    if units <= 65534:
        record["cone_axis"], record["cone_angle"] = axis[0], units
