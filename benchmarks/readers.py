"""CPU time a sample of every reader, on generated files of a million samples.

Usage: PYTHONPATH=common:server:client python benchmarks/readers.py [--samples 1M]
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import asked
import laspy
import numpy as np
import pye57
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from pointbuild.readers import finite, open_scan


def columns(count: int) -> dict[str, np.ndarray[Any, Any]]:
    """A bumpy sphere with normals, colours and intensities."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(count, 3)).astype("f4")
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    xyz = (normal * (1 + 0.1 * np.sin(9 * normal[:, :1]))).astype("f4")
    out = dict(zip("xyz", xyz.T, strict=True)) | dict(zip(("nx", "ny", "nz"), normal.T, strict=True))
    out |= {name: rng.integers(0, 256, count).astype("u1") for name in ("red", "green", "blue")}
    return out | {"intensity": rng.integers(0, 4096, count).astype("f4")}


def write_all(folder: Path, count: int) -> list[Path]:
    data = columns(count)
    rows = np.rec.fromarrays(list(data.values()), names=list(data))
    xyz = np.stack([data[name] for name in "xyz"], axis=1).astype("f8")
    paths = [folder / name for name in ("little.ply", "big.ply", "ascii.ply")]
    for path, how in zip(paths, ({"byte_order": "<"}, {"byte_order": ">"}, {"text": True}), strict=True):
        PlyData([PlyElement.describe(np.asarray(rows), "vertex")], **how).write(path)

    side = int(np.sqrt(count))
    k = np.arange((side - 1) ** 2)
    k = k // (side - 1) * side + k % (side - 1)
    triangles = np.concatenate([np.stack([k, k + 1, k + side], 1), np.stack([k + 1, k + side + 1, k + side], 1)])
    faces = np.zeros(len(triangles), [("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\nproperty float y\n"
    head += f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    paths.append(folder / "mesh.ply")
    paths[-1].write_bytes(head.encode() + xyz.astype("<f4").tobytes() + faces.tobytes())

    for suffix in ("las", "laz"):
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.scales = [1e-6] * 3
        las = laspy.LasData(header)
        las.xyz = xyz
        las.red, las.green, las.blue = (data[name].astype("u2") * 257 for name in ("red", "green", "blue"))
        las.intensity = data["intensity"].astype("u2")
        paths.append(folder / f"pf7.{suffix}")
        las.write(paths[-1])

    paths.append(folder / "scan.e57")
    with pye57.E57(str(paths[-1]), mode="w") as file:
        named = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T.copy(), strict=True))
        file.write_scan_raw(named | {f"color{name.title()}": data[name] for name in ("red", "green", "blue")})

    fields = ("x", "y", "z", "intensity")
    cloud = PointCloud.from_points([data[name] for name in fields], fields, (np.float32,) * 4)
    for encoding in (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED):
        paths.append(folder / f"{encoding.value}.pcd")
        cloud.save(paths[-1], encoding)

    for name, chosen, separator in (("xyz.xyz", "xyz", " "), ("all.csv", tuple(data), ",")):
        paths.append(folder / name)
        table = np.stack([data[column] for column in chosen], axis=1)
        np.savetxt(paths[-1], table, fmt="%.7g", delimiter=separator)

    arrays = {"xyz": xyz, "color": np.stack([data[name] for name in ("red", "green", "blue")], axis=1)}
    for name, save in (("plain.npz", np.savez), ("deflated.npz", np.savez_compressed)):
        paths.append(folder / name)
        save(paths[-1], **arrays)  # type: ignore[arg-type]
    return paths


def measure(path: Path) -> tuple[float, float, int]:
    """CPU seconds of opening and of reading, and the samples."""
    began = time.process_time()
    scan = open_scan(path)
    opened = time.process_time()
    samples = sum(len(finite(batch)[0]) for batch in scan.batches(1 << 18))
    return opened - began, time.process_time() - opened, samples


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--samples", type=asked.samples, default=1_000_000)
    count = parser.parse_args().samples
    print(f"{'file':28}{'bytes/sample':>14}{'open ms':>10}{'ns/sample':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for path in write_all(Path(folder), count):
            runs = [measure(path) for _ in range(3)]
            opening, reading = (min(run[k] for run in runs) for k in (0, 1))
            samples = runs[0][2]
            each = path.stat().st_size / samples
            print(f"{path.name:28}{each:14.1f}{1e3 * opening:10.1f}{1e9 * reading / samples:12.0f}", flush=True)


if __name__ == "__main__":
    main()
