"""What a build takes of the disk: predicted, checked, kept, and at most three times the input's records."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import laspy
import numpy as np
import pytest

import pointbuild.build
from lpc.errors import BuildError
from pointbuild import BuildOptions, build_model
from pointbuild.disk import FIXED, Need

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SAMPLES = 150_000
OPTIONS = BuildOptions(threads=2, cloud_size=256, bucket_samples=6000, block_samples=8000)
"""As `memory.choose_sizes` would do for an input that is large beside a bucket."""


def noise(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and colours that nothing can predict: the largest model of so many samples."""
    rng = np.random.default_rng(0)
    return rng.random((count, 3)).astype(np.float32), rng.integers(0, 256, (count, 3), np.uint8)


def las(path: Path, fmt: int) -> int:
    xyz, color = noise(SAMPLES)
    header = laspy.LasHeader(point_format=fmt, version="1.4" if fmt >= 6 else "1.2")
    header.scales = np.full(3, 1e-6)
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = xyz.T
    scan.intensity = np.random.default_rng(1).integers(0, 65536, SAMPLES)
    if "red" in header.point_format.dimension_names:
        scan.red, scan.green, scan.blue = color.T.astype(np.uint16) * 251
    scan.write(path)
    return header.point_format.size


def ply(path: Path, kind: str, colored: bool) -> int:
    xyz, color = noise(SAMPLES)
    fields = [(axis, kind) for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")] * colored
    rows = np.zeros(SAMPLES, fields)
    for part, values in (("xyz", xyz), (("red", "green", "blue"), color)):
        for name, column in zip(part, values.T, strict=True):
            if name in rows.dtype.names:
                rows[name] = column * (1 + 1e-9) if name in "xyz" and kind == "<f8" else column
    types = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    lines = [f"property {types[item]} {name}" for name, item in fields]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {SAMPLES}", *lines, "end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
    return rows.dtype.itemsize


def text(path: Path) -> int:
    np.savetxt(path, noise(SAMPLES)[0].astype(float) * (1 + 1e-9), "%.9f")
    return 24  # as numbers; the text itself is longer


class Watching:
    """Looks at a folder whenever the build gets on."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.most = folder, 0

    def stage(self, name: str, total: int | None) -> None:
        self.advance(0)

    def advance(self, samples: int) -> None:
        used = 0
        for path in self.folder.rglob("*"):
            try:
                used += path.stat().st_blocks * 512
            except FileNotFoundError:
                continue
        self.most = max(self.most, used)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("0.las", lambda path: las(path, 0)),
        ("2.las", lambda path: las(path, 2)),
        ("7.las", lambda path: las(path, 7)),
        ("2.laz", lambda path: las(path, 2)),
        ("single.ply", lambda path: ply(path, "<f4", False)),
        ("color.ply", lambda path: ply(path, "<f4", True)),
        ("double.ply", lambda path: ply(path, "<f8", True)),
        ("some.xyz", text),
    ],
)
def test_no_more_than_predicted_and_three_times_the_records(
    name: str, write: Callable[[Path], int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = SAMPLES * write(tmp_path / name)
    predicted: list[Need] = []
    real = pointbuild.build.disk.predict

    def predict(*arguments: int) -> Need:
        predicted.append(real(*arguments))
        return predicted[-1]

    monkeypatch.setattr(pointbuild.build.disk, "predict", predict)
    (tmp_path / "out").mkdir()
    watching = Watching(tmp_path / "out")
    build_model([tmp_path / name], tmp_path / "out" / "m.lpc", OPTIONS, watching, clock=time.monotonic)
    need = predicted[-1]
    assert watching.most <= need.temporary
    assert (tmp_path / "out" / "m.lpc").stat().st_size <= need.model
    if name != "some.xyz":  # whose number of samples is not known before
        assert need.temporary - 2 * FIXED <= 3 * raw
    assert watching.most <= 3 * raw


def test_files_that_can_be_gone_on_with_count_as_room(tmp_path: Path) -> None:
    need = Need(temporary=10**18, model=10)
    with pytest.raises(BuildError, match="make room, or choose another place for temporary files"):
        pointbuild.build.disk.check_space(need, tmp_path, 0, tmp_path / "m.lpc")
    pointbuild.build.disk.check_space(need, tmp_path, 10**18, tmp_path / "m.lpc")
