"""How closed closed surfaces look: `PYTHONPATH=common:server:client:tests python benchmarks/closed.py`.

200,000 random samples of a sphere and of a torus, at several tolerances and with only the first clouds resident. Holes
are pixels of the surface that show the background or the far side; growth is that of the silhouette, in spacings.
"""

from __future__ import annotations

import asked
import numpy as np
from support import models, traced

from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend


def main() -> None:
    asked.nothing(__doc__)
    camera = Camera(eye=(1, -2.5, 2), target=(0, 0, 0), up=(0, 0, 1), width=400, height=400)
    print(f"{'model':8} {'splats':12} {'tolerance':>9} {'clouds':>7} {'starved':>7} {'px':>5} {'holes %':>8}  growth")
    for name, model, distance in (
        ("sphere", models.sphere(200_000, cloud_size=1024), traced.sphere_distance),
        ("torus", models.torus(200_000, cloud_size=1024), traced.torus_distance),
    ):
        exact = traced.trace(distance, camera)
        backend = CpuBackend(model.header)
        scattered = np.random.default_rng(0).random(model.header.nodes) < 0.7
        scattered[0] = True
        cuts = [(tolerance, model.everything) for tolerance in (1.0, 2.0, 4.0, 8.0)]
        cuts += [(1.0, model.first(nodes)) for nodes in (1, 8, 40, 100)] + [(1.0, scattered)]
        for style, kind in ((Style(), "discs"), (Style(two_sided=True, splat="round"), "facing")):
            for tolerance, resident in cuts:
                cut = refine(model.index, camera, tolerance, resident, cull_backfaces=not style.two_sided)
                frame = backend.draw(cut, model.take, camera, style)
                holes = traced.hole_share(frame, exact, 0.3 + 1.5 * cut.spacing.max())
                grown = traced.growth(frame, exact) / max(1.0, cut.max_spacing_px)
                print(
                    f"{name:8} {kind:12} {tolerance:9g} {len(cut.nodes):7d} {int(cut.starved.sum()):7d}"
                    f" {cut.max_spacing_px:5.1f} {100 * holes:8.3f} {grown:7.2f}"
                )


if __name__ == "__main__":
    main()
