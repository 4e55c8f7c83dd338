"""The whole tour: build a model, serve it, stream it over the paper's ADSL line, say what it cost.

It runs the very commands that it prints, as a stranger at a terminal would.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.errors import LpcError, Unavailable
from lpc.info import counted

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

SHIPPED_SCAN = Path(__file__).resolve().parents[3] / "tests" / "data" / "lone-star.copc.laz"
"""A real scan beside the sources; tests/data/README.md has its source and licence."""

ISOSURFACE_SAMPLES = 600_000


class DemoFailed(LpcError):  # noqa: N818 - the one line that the user reads follows the command's own
    """A command of the tour failed; it has said why."""


def tour(folder: Path, *, scan: Path | None, seconds: float, link: str) -> Iterator[str]:
    """Run the tour; yield what to tell the user, line by line.

    Parameters
    ----------
    folder : Path
        Where the model and the report go.
    scan : Path, optional
        A scan to build; the shipped one, or a procedural isosurface where there is none.
    seconds : float
        Length of the streaming run.
    link : str
        Profile of the link.

    Raises
    ------
    LpcError
        If a command fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scan = scan or (SHIPPED_SCAN if SHIPPED_SCAN.is_file() else _isosurface(folder / "isosurface.npz"))
    model = folder / "model.lpc"
    report = folder / "report"
    yield from _announce("build", str(scan), "-o", str(model))
    built = _run("build", str(scan), "-o", str(model))
    yield (
        f"  {counted(built['samples'], 'sample')} in {counted(built['clouds'], 'cloud')}, {built['bytes']:,} bytes"
        f" ({built['bits_per_sample']['total']:.1f} bits a sample), {built['seconds']:.1f} s"
    )
    yield from _announce("serve", str(folder), "--port", "0")
    with _serving(folder) as address:
        yield f"  {address}"
        arguments = (f"{address}model.lpc", "--link", link, "--seconds", f"{seconds:g}", "--report", str(report))
        yield from _announce("stream", *arguments)
        result = _run("stream", *arguments)
    yield ""
    yield f"Pictures at {_picture_times(report)} s, and curve.png: {report}"
    yield ""
    yield from _five_figures(result)


def _picture_times(report: Path) -> str:
    """Name the times of the pictures that are there, "1, 10 and 12.5"."""
    times = sorted(float(path.name[6:-5]) for path in report.glob("frame-*[0-9]s.png"))
    *most, last = [f"{time:g}" for time in times]
    return f"{', '.join(most)} and {last}" if most else last


def _five_figures(result: dict[str, Any]) -> Iterator[str]:
    """Say the figures that matter, with their names in report.json."""
    ten = min(result["curve"], key=lambda entry: abs(entry["t"] - 10.0))
    error = f"error after {ten['t']:.3g} s"
    psnr = "equal" if ten["psnr_db"] is None else f"{ten['psnr_db']:.1f} dB"
    settled = "not yet" if result["settled_s"] is None else f"{result['settled_s']:.1f} s"
    use = "-" if result["link_utilisation"] is None else f"{100 * result['link_utilisation']:.1f} %"
    first = "none" if result["first_picture_s"] is None else f"{result['first_picture_s']:.2f} s"
    yield f"  first picture            {first:>12}   first_picture_s"
    yield f"  view complete            {settled:>12}   settled_s"
    yield f"  {error:<25}{psnr:>12}   curve[].psnr_db, SSIM {ten['ssim']:.3f}"
    yield f"  link carrying payload    {use:>12}   link_utilisation"
    requests = counted(result["requests"], "request")
    yield f"  received                 {result['bytes'] / 1e6:>9.2f} MB   bytes, in {requests}"


def _announce(*arguments: str) -> Iterator[str]:
    yield "$ pointstream " + " ".join(arguments)


def _command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "pointstream", *arguments]


def _run(*arguments: str) -> dict[str, Any]:
    """Run a sub-command with --json; its progress and errors go to the user's terminal."""
    done = subprocess.run([*_command(*arguments), "--json"], stdout=subprocess.PIPE, check=False)
    if done.returncode != 0:
        raise DemoFailed(f"`pointstream {arguments[0]}` ended with status {done.returncode}; what it said is above")
    return dict(json.loads(done.stdout))


@contextmanager
def _serving(folder: Path) -> Iterator[str]:
    """Serve a folder on a free port; yield the address with its trailing slash."""
    server = subprocess.Popen(
        _command("serve", str(folder), "--port", "0", "--quiet"), stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        address = next((word for word in line.split() if word.startswith("http://")), None)
        if address is None:
            raise Unavailable("`pointstream serve` did not start; what it said is above")
        yield address.rstrip("/") + "/"
    finally:
        server.terminate()
        try:
            server.wait(timeout=10)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
        if server.stdout is not None:
            server.stdout.close()


def _isosurface(path: Path) -> Path:
    """Write random samples of a gyroid with normals and colours as a scan.

    The surface is f = sin x cos y + sin y cos z + sin z cos x = 0 inside a ball. Samples are random points of a thin
    layer about it, moved on to the surface by Newton's rule along the gradient, which is also the normal.
    """
    rng = np.random.default_rng(0)
    radius, layer = 3.0 * np.pi, 0.15
    parts: list[Array] = []
    found = 0
    while found < ISOSURFACE_SAMPLES:
        xyz = rng.uniform(-radius, radius, (400_000, 3))
        xyz = xyz[np.einsum("ij,ij->i", xyz, xyz) < radius**2]
        value, slope = _gyroid(xyz)
        near = value**2 < layer**2 * np.einsum("ij,ij->i", slope, slope)
        xyz, value, slope = xyz[near], value[near], slope[near]
        for _ in range(3):
            xyz -= slope * (value / np.einsum("ij,ij->i", slope, slope))[:, None]
            value, slope = _gyroid(xyz)
        parts.append(xyz)
        found += len(xyz)
    xyz = np.concatenate(parts)[:ISOSURFACE_SAMPLES]
    _, normal = _gyroid(xyz)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shade = 0.5 + 0.5 * np.sin(xyz * (0.5 + np.arange(3)) * 0.35 + np.arange(3))
    color = (90.0 + 150.0 * shade).astype(np.uint8)
    np.savez(path, xyz=xyz, normal=normal.astype(np.float32), color=color)
    return path


def _gyroid(xyz: Array) -> tuple[Array, Array]:
    """Return f (n,) and its gradient (n, 3)."""
    sin_x, sin_y, sin_z = np.sin(xyz).T
    cos_x, cos_y, cos_z = np.cos(xyz).T
    value = sin_x * cos_y + sin_y * cos_z + sin_z * cos_x
    gradient = np.stack(
        [cos_x * cos_y - sin_z * sin_x, cos_y * cos_z - sin_x * sin_y, cos_z * cos_x - sin_y * sin_z], axis=1
    )
    return value, gradient
