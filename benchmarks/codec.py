"""Bits per sample and CPU speed of the codec on real scans: ``python benchmarks/codec.py FOLDER [NAME...]``.

Each scan is cut into clouds by a plain recursive midpoint tree with random samples of M (LPC section 3), quantised
with an error bound of r / 2 and 8 + 8 bits a normal. Sizes include the frame and the payload's header.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import asked
import numpy as np
import zstandard
from plyfile import PlyData
from scipy.spatial import cKDTree

from lpc.attributes import Attribute, Schema
from lpc.channels import channels_of
from lpc.codec import decode_cloud, encode_clouds
from lpc.context import line_of
from lpc.lattice import position_step, quantise
from lpc.octahedral import encode_normals
from lpc.payload import RAW_BITS, parse_layout

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.codec import Effort, Engine

NORMAL = Attribute(name="normal", kind="normal", dtype="<f4", bits=8)
COLOR = Attribute(name="color", kind="color", dtype="|u1", bits=8)
OBJECTS = ("stanford_dragon.ply", "lion_takanawa.ply", "armadillo.obj", "ankylosaurus_mesh.ply", "car_cloud400.csv",
           "bunnyInt32.e57")  # fmt: skip


def load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8] | None]:
    """Positions, normals and colours of a scan."""
    faces, color = None, None
    if path.suffix == ".ply":
        ply = PlyData.read(path)
        vertex = ply["vertex"]
        xyz = np.stack([vertex[name] for name in "xyz"], axis=1).astype(np.float64)
        names = {prop.name for prop in vertex.properties}
        if "red" in names:
            color = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=1)
        if "nx" in names:
            return xyz, np.stack([vertex[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64), color
        if "face" in ply:
            faces = np.stack(ply["face"].data[ply["face"].properties[0].name])
    elif path.suffix == ".obj":
        lines = path.read_text().splitlines()
        xyz = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64)
        corners = [[c.split("/")[0] for c in line.split()[1:4]] for line in lines if line.startswith("f ")]
        faces = np.array(corners, np.int64) - 1
    elif path.suffix == ".csv":
        table = np.genfromtxt(path, delimiter=",", skip_header=1)
        return table[:, :3], table[:, 3:6], None
    elif path.suffix == ".e57":
        import pye57

        scan = pye57.E57(str(path)).read_scan(0, ignore_missing_fields=True)
        xyz = np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    else:
        import laspy

        xyz = np.array(laspy.read(path).xyz)
    if faces is not None:
        return xyz, face_normals(xyz, faces), color
    return xyz, estimated_normals(xyz), color


def face_normals(xyz: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sum of the normals of a vertex' faces, weighted by area."""
    a, b, c = (xyz[faces[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)
    return np.stack([np.bincount(faces.ravel(), np.repeat(area[:, axis], 3), len(xyz)) for axis in range(3)], axis=1)


def estimated_normals(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least axis of 12 neighbours, turned away from the middle."""
    _, near = cKDTree(xyz).query(xyz, 12)
    patch = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", patch, patch))[1][:, :, 0]
    return normals * np.where((normals * (xyz - xyz.mean(axis=0))).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def model_spacing(xyz: NDArray[np.float64], seed: int) -> float:
    """Median of sqrt(area per sample): sqrt(pi / 8) of the distance to the 8th neighbour."""
    some = xyz[np.random.default_rng(seed).permutation(len(xyz))[:20_000]]
    return float(np.median(cKDTree(xyz).query(some, 9)[0][:, 8]) * np.sqrt(np.pi / 8))


def clouds(xyz: NDArray[np.float64], size: int, seed: int) -> Iterator[tuple[NDArray[np.int64], int]]:
    """Sample numbers of each node, and the number of its parent; -1 for the root."""
    todo = [(np.random.default_rng(seed).permutation(len(xyz)), xyz.min(axis=0), xyz.max(axis=0), -1)]
    count = 0
    while todo:
        members, low, high, parent = todo.pop()
        yield members[:size], parent
        number, count = count, count + 1
        rest = members[size:]
        if len(rest):
            axis = int(np.argmax(high - low))
            middle = (low[axis] + high[axis]) / 2
            below = xyz[rest, axis] < middle
            for side, bound, which in ((rest[below], high, 1), (rest[~below], low, 0)):
                cut = bound.copy()
                cut[axis] = middle
                if len(side):
                    todo.append((side, low, cut, number) if which else (side, cut, high, number))


def stream_bits(frame: bytes, samples: int, schema: Schema) -> dict[str, float]:
    """Bits of a frame by what they hold, from its blocks."""
    channels = channels_of(schema)
    payload = zstandard.ZstdDecompressor().decompress(frame)
    layout = parse_layout(payload, samples=samples, channels=channels)
    tokens = np.frombuffer(payload, np.uint8, offset=layout.tokens).reshape(-1, samples)
    raw = RAW_BITS[tokens].sum(axis=1, dtype=np.int64)
    sizes, at = [], zstandard.frame_header_size(frame)
    while True:
        header = int.from_bytes(frame[at : at + 3], "little")
        size = 1 if header >> 1 & 3 == 1 else header >> 3
        sizes.append(8 * (3 + size))
        at += 3 + size
        if header & 1:
            break
    bits = {"position": float(raw[0] + sizes[1])}
    for (first, stop), block in zip(channels.groups, sizes[2:], strict=False):
        name = "normal" if first == 0 else "color"
        bits[name] = bits.get(name, 0.0) + float(raw[1 + first : 1 + stop].sum() + block)
    bits["header"] = 8.0 * len(frame) - sum(bits.values())
    return bits


def rate(work: Callable[[], object], samples: int, repeats: int) -> float:
    """Million samples per second of CPU, the best of a few runs."""
    best = float("inf")
    for _ in range(repeats):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return samples / best / 1e6


class Scan(NamedTuple):
    """Clouds of a scan one after another, and the number of each one's parent."""

    lattice: NDArray[np.int64]
    codes: dict[str, NDArray[Any]]
    schema: Schema
    bounds: NDArray[np.int64]
    parent: list[int]

    @classmethod
    def of(cls, path: Path, size: int, with_color: bool) -> Scan:
        xyz, normals, color = load(path)
        spacing = model_spacing(xyz, 1)
        lattice = quantise(xyz, xyz.min(axis=0), position_step(spacing, float(np.ptp(xyz, axis=0).max())))
        codes: dict[str, NDArray[Any]] = {"normal": encode_normals(normals)}
        schema: Schema = (NORMAL,)
        if with_color and color is not None:
            schema, codes["color"] = (NORMAL, COLOR), color
        parts = list(clouds(xyz, size, 2))
        order = np.concatenate([part for part, _ in parts])
        bounds = np.cumsum([0, *(len(part) for part, _ in parts)])
        parent = [parent for _, parent in parts]
        return cls(lattice[order], {name: code[order] for name, code in codes.items()}, schema, bounds, parent)

    def encode(self, effort: Effort) -> list[bytes]:
        parent = np.array(self.parent)
        return encode_clouds(self.lattice, self.codes, self.bounds, self.schema, parent=parent, effort=effort)

    def decode(self, frames: list[bytes], engine: Engine) -> None:
        known: list[Cloud] = []
        counts = np.diff(self.bounds).tolist()
        for number, (frame, count) in enumerate(zip(frames, counts, strict=True)):
            context = [known[above] for above in line_of(number, self.parent)]
            known.append(decode_cloud(frame, samples=count, schema=self.schema, context=context, engine=engine))


def measure(path: Path, size: int, effort: Effort, repeats: int, with_color: bool) -> None:
    scan = Scan.of(path, size, with_color)
    counts, samples = np.diff(scan.bounds).tolist(), len(scan.lattice)
    frames = scan.encode(effort)
    totals: dict[str, float] = {}
    for frame, count in zip(frames, counts, strict=True):
        for name, bits in stream_bits(frame, count, scan.schema).items():
            totals[name] = totals.get(name, 0.0) + bits
    speeds = [rate(lambda: scan.encode(effort), samples, repeats)]
    engines: tuple[Engine, ...] = ("compiled", "numpy")
    for engine in engines:
        scan.decode(frames, engine)
        speeds.append(rate(partial(scan.decode, frames, engine), samples, repeats))
    bits = {name: totals.get(name, 0.0) / samples for name in ("position", "normal", "color", "header")}
    total = 8 * sum(map(len, frames)) / samples
    print(
        f"{path.name:24} {samples:9,} {len(counts):6,} " + " ".join(f"{value:8.2f}" for value in bits.values())
        + f" {total:8.2f} {1 / speeds[0]:7.2f} {speeds[1]:7.2f} {speeds[2]:7.2f}"
    )  # fmt: skip


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=OBJECTS)
    parser.add_argument("--cloud-size", type=int, default=2048)
    parser.add_argument("--effort", default="default", choices=["default", "best", "fast"])
    parser.add_argument("--color", action="store_true", help="colours, too, where the scan has them")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    print(f"{'':41} bits a sample {'':29} us/sample   decoded, M samples/s of CPU")
    streams = " ".join(f"{name:>8}" for name in ("position", "normal", "color", "header", "total"))
    print(f"{'scan':24} {'samples':>9} {'clouds':>6} {streams} {'encode':>7} {'compil.':>7} {'numpy':>7}")
    for name in options.names:
        measure(options.folder / name, options.cloud_size, options.effort, options.repeats, options.color)


if __name__ == "__main__":
    main()
