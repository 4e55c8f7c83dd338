"""The spacing that a sample must close, by walking the tree of the cut in float64: slow and obvious."""

from __future__ import annotations

import math

import numpy as np

from pointview import snug, splats
from pointview.render.pack import Packer
from pointview.render.tables import STEPS


def share(index, node, camera):
    """Share of a splat's size that does where a node is the deepest (`pointview.snug`), a number at a time."""

    def ramp(value, start, stop):
        return min(max((value - start) / (stop - start), 0.0), 1.0)

    gap = math.dist(index.center[node], camera.eye) - index.radius[node]
    spacing_px = index.density.coarseness[node] * camera.focal / gap if gap > 0 else math.inf
    if spacing_px <= snug.FINE:
        return 1.0
    folds = ramp(index.density.area[node] / (math.pi * index.radius[node] ** 2), snug.FLAT, snug.FOLDED)
    family = [node, *([index.parent[node]] if node else [])]
    falls = max(ramp(index.density.contrast[one], snug.EVEN, snug.FALLING) for one in family)
    return max(snug.SNUG + (1 - snug.SNUG) * max(folds, falls), snug.FINE / spacing_px)


def cell_of(header, path):
    """Box (2, 3) of the cell that a path of halves leads to, and the axis along which it is halved next."""
    low, high = np.array(header.bounds, dtype=float).reshape(2, 3)
    for half in path:
        axis = int(np.argmax(high - low))
        middle = (low[axis] + high[axis]) / 2
        (low if half else high)[axis] = middle
    return np.array([low, high]), int(np.argmax(high - low))


def path_of(index, node):
    """Halves from the root to a node."""
    path = []
    while index.parent[node] >= 0:
        parent = index.parent[node]
        path.insert(0, int(index.children[parent][1] == node))
        node = parent
    return path


class Walk:
    """Looks spacings up in one cut."""

    def __init__(self, model, cut, camera):
        self.index, self.header, self.model, self.camera = model.index, model.header, model, camera
        self.spacing = dict(zip(cut.nodes.tolist(), cut.spacing.tolist(), strict=True))
        self.wants = set(cut.wants.tolist())

    def end(self, node, half):
        """What half a cell without a drawn node shows: spacing, starved."""
        child = int(self.index.children[node][half])
        if child in self.wants:
            return float(self.index.spacing[node]) * share(self.index, node, self.camera), True
        return self.spacing[node], False

    def coarsest(self, node, half):
        child = int(self.index.children[node][half])
        return self.spacing[child] if child in self.spacing else self.end(node, half)[0]

    def deepest(self, node, xyz):
        """Spacing and starvation of the cell below a drawn node that holds a position."""
        box, axis = cell_of(self.header, path_of(self.index, node))
        half = int(xyz[axis] >= box[:, axis].mean())
        child = int(self.index.children[node][half])
        return self.deepest(child, xyz) if child in self.spacing else self.end(node, half)

    def at(self, node, xyz):
        """Spacing to close at a sample of a drawn node, and whether its place is starved."""
        own, starved = self.deepest(node, xyz)
        if (own, starved) == self.deepest_everywhere(node):
            return own, starved
        spacing, here = own, node
        while here in self.spacing:
            box, axis = cell_of(self.header, path_of(self.index, here))
            middle = box[:, axis].mean()
            half = int(xyz[axis] >= middle)
            apart = abs(xyz[axis] - middle)
            across = np.array(xyz, dtype=float)
            across[axis] = middle - 1e-9 * (box[1] - box[0])[axis] if half else middle
            beyond = int(self.index.children[here][1 - half])
            if beyond in self.spacing:
                if apart < splats.REACH * self.spacing[beyond]:
                    facing, _ = self.deepest(beyond, across)
                else:
                    facing = 0.0
            else:
                facing, _ = self.end(here, 1 - half)
            if apart < splats.REACH * facing:
                spacing = max(spacing, facing)
            here = int(self.index.children[here][half])
        return spacing, starved

    def of_samples(self, node):
        """Spacings to close at all samples of a drawn node: at their places, or around them where these are thin."""
        packed = Packer(self.header).pack(self.model.clouds[node], 1 << 16)
        density, found = self.index.density, []
        for xyz, code in zip(self.model.positions(node), packed.color[:, 3].tolist(), strict=True):
            found.append(self.at(node, xyz)[0])
            if code:
                full = packed.scale * 2.0 ** (code / STEPS) * np.sqrt(density.own[node])
                found[-1] = max(found[-1], full / np.sqrt(density.drawn[self.deepest_node(node, xyz)]))
        return found

    def deepest_node(self, node, xyz):
        """Deepest drawn node whose cell holds a position in that of a drawn one."""
        box, axis = cell_of(self.header, path_of(self.index, node))
        child = int(self.index.children[node][int(xyz[axis] >= box[:, axis].mean())])
        return self.deepest_node(child, xyz) if child in self.spacing else node

    def deepest_everywhere(self, node):
        """The same for all samples of a node that no drawn node refines, if both halves agree."""
        if any(int(child) in self.spacing for child in self.index.children[node]):
            return None
        ends = {self.end(node, half) for half in (0, 1)}
        return ends.pop() if len(ends) == 1 else None
