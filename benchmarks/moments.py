"""Closed surfaces at every moment of a streaming run: `PYTHONPATH=tests .venv/bin/python benchmarks/moments.py`.

Spheres, tori and bumpy spheres, sampled evenly, on a grid and most unevenly, with and without normals, arrive over
simulated lines while the camera stands or moves. Every picture is compared with the exact surface as rays meet it.
Holes are pixels of the surface that show the background or the far side, percent; growth is that of the silhouette, in
spacings of the samples drawn there, of at least a pixel: the mean, the 99th percentile and the most along all of it.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import asked
import numpy as np
from support import shells
from support.moments import Run, watch


def runs(quick: bool) -> list[Run]:
    """What is tried: all ways to sample all surfaces, then lines, cameras, windows, tolerances and sizes."""
    kinds = [(shell, normals) for shell in shells.SHELLS for normals in (True, False)]
    found = [Run(shell, sampling, normals) for sampling in shells.SAMPLINGS for shell, normals in kinds]
    if quick:
        return found
    found += [Run(shell, normals=normals, moving=True) for shell, normals in kinds]
    found += [Run(shell, normals=normals, tolerance=pixels) for shell, normals in kinds for pixels in (2.0, 4.0)]
    found += [Run(shell, normals=normals, link=link) for shell, normals in kinds for link in ("128k", "lan")]
    found += [Run(shell, normals=normals, size=size) for shell, normals in kinds for size in ((160, 120), (1024, 768))]
    found += [Run(shell, normals=normals, samples=count) for shell, normals in kinds for count in (3_000, 20_000)]
    return found


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="only the surfaces and their samplings")
    parser.add_argument("--every", type=float, default=0.1, help="seconds from one picture to the next")
    parser.add_argument("--only", default="", help="rows whose text holds this")
    parser.add_argument("--keep", type=Path, help="folder for the models, to use them again")
    arguments = parser.parse_args()
    print(
        f"{'surface':8} {'sampling':8} {'normals':7} {'samples':>9} {'link':>5} {'camera':6} {'window':>9} {'px':>3}"
        f" {'pictures':>8} {'holes %':>8} {'worst':>8} {'at s':>5} {'last':>7} {'growth':>7} {'99%':>5} {'most':>5}"
    )
    with TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for run in runs(arguments.quick):
            label = (
                f"{run.shell.name:8} {run.sampling:8} {'yes' if run.normals else 'no':7} {run.samples:9,} {run.link:>5}"
                f" {'moving' if run.moving else 'still':6} {'x'.join(map(str, run.size)):>9} {run.tolerance:3g}"
            )
            if arguments.only in label:
                print(label, figures(run, run.build(folder), arguments.every), flush=True)


def figures(run: Run, path: Path, every: float) -> str:
    """Stream a model and say what its pictures were like."""
    moments = watch(run, path, every=every)
    holes = 100 * np.array([moment.holes for moment in moments])
    worst = int(np.argmax(holes))
    row = f"{len(moments):8d} {holes.mean():8.4f} {holes[worst]:8.4f} {moments[worst].t:5.2f} {holes[-1]:7.4f}"
    growth = np.concatenate([moment.growth for moment in moments])
    if not len(growth):
        return row
    return f"{row} {growth.mean():7.2f} {np.percentile(growth, 99):5.2f} {growth.max():5.2f}"


if __name__ == "__main__":
    main()
