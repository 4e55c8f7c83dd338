"""Occlusion culling (LPC 4): what the last frames did not show is neither drawn nor refined nor fetched.

The paper draws what the last frame showed, asks the hardware how many fragments of each candidate's bounding sphere
would pass, and draws what newly does. Spheres of folded sheets overlap far more than the sheets. Here the question goes
to the picture: a pixel's depth gives a point of the surface, and the cells of the tree that hold the point are seen.
The samples of a node's ancestors are spread over its cell, so they answer for a node that is not drawn, or not even
here, as well. Each frame has the paper's three phases:

1. the cut is refined without the nodes found hidden, and drawn;
2. all candidates are tested, drawn or not: which cells does the picture show?
3. where a hidden one is seen, the cut is refined and drawn again.

Samples of ancestors answer only for what is larger than their spacing. A node is therefore hidden only where its
parent's samples are at most `PROBE` pixels apart, and it stays a few tests longer than it is seen. One whose parent was
not drawn in the last test is not hidden: what is known of it is old.

The tests cost a share of each frame. Where they hide few nodes they are paused, and `Occlusion.verdict` says so. A
coarse picture tells little of a fine one, so a cut that has doubled since is tried again at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .render.seen import pixels_by_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

    from .camera import Camera
    from .refine import Cut
    from .render import Frame

PROBE = 24.0
"""Largest projected spacing of samples that are trusted to show what is behind gaps, pixels."""

KEPT = 3
"""Tests for which a node stays visible after it was last seen: a moving camera sees it again soon."""

WORTH = 0.15
"""Share of the tested nodes that must be hidden for culling to pay."""

TRIAL = 4
"""Tests after which that is decided."""

PAUSE = 60
"""Tests left out then, before the next trial."""

GROWN = 2
"""Nodes drawn, over those when that was decided, that make a trial worth it at once."""


class Occlusion:
    """What earlier frames of one view of one model told about hidden nodes.

    Parameters
    ----------
    nodes : int
        Of the model.
    kept : int
        Tests for which a node stays visible; 1 where the camera stands still.

    Attributes
    ----------
    hidden : (nodes,) bool
        For `refine`.
    """

    def __init__(self, nodes: int, *, kept: int = KEPT) -> None:
        self._kept = kept
        self.hidden = np.zeros(nodes, dtype=bool)
        self._tested = np.zeros(nodes, dtype=np.int32)  # number of the last test, from 1 on
        self._seen = np.zeros(nodes, dtype=np.int32)
        self._test = 0
        self._camera: Camera | None = None
        self._back = np.zeros(nodes, dtype=bool)
        self._trial, self._pause = 0, 0
        self._share, self._judged = 0.0, 0

    @property
    def verdict(self) -> str | None:
        """Why nothing is culled, or None while culling is on."""
        if self._pause == 0:
            return None
        return f"occlusion culling is paused: {100 * self._share:.0f}% of the nodes are hidden, tests cost more"

    @property
    def left_out(self) -> dict[str, str]:
        """The verdict as reports state it: what is left out, and why."""
        return {} if self.verdict is None else {"occlusion": self.verdict}

    def look(self, index: IndexTree, cut: Cut, camera: Camera, frame: Frame, *, stride: int = 1) -> int:
        """Learn from the picture of a cut; return how many nodes that were hidden are seen now.

        Parameters
        ----------
        cut : Cut
            Refined with `hidden` as it is now, by the rule "place".
        stride : int
            Look at every so many pixels of every so many lines.
        """
        if self._pause > 0:
            self._pause = 0 if len(cut.nodes) >= GROWN * self._judged else self._pause - 1
            return 0
        if cut.places is None or not len(cut.nodes):
            return 0
        self._test += 1
        children = index.children[cut.nodes]
        fine = self._fine(index, cut, camera)
        counts = pixels_by_cell(frame.depth, cut, camera, stride=stride)
        tested = (children >= 0) & fine[:, None]
        seen = children[(children >= 0) & (counts > 0)]
        self._tested[children[tested]] = self._test
        self._seen[seen] = self._test
        before = self.hidden
        now = np.zeros_like(before)
        nodes = children[tested]
        now[nodes] = self._seen[nodes] <= self._test - self._kept
        # A node on the edge of being seen would come and go for ever: what comes back stays while the camera stands.
        if camera != self._camera:
            self._camera = camera
            self._back[:] = False
        self._back[seen[before[seen]]] = True
        now &= ~self._back
        self.hidden = now
        self._judge(len(cut.nodes), len(nodes), int(np.count_nonzero(now)))
        return int(np.count_nonzero(before[seen]))

    def _fine(self, index: IndexTree, cut: Cut, camera: Camera) -> NDArray[np.bool_]:
        """Nodes whose samples are near enough to each other to tell what is hidden, and wholly in front of the eye."""
        offset = index.center[cut.nodes] - np.array(camera.eye)
        gap = np.sqrt(np.einsum("ij,ij->i", offset, offset)) - index.radius[cut.nodes]
        return np.asarray(index.density.coarseness[cut.nodes] * camera.focal < PROBE * gap)

    def _judge(self, drawn: int, tested: int, hidden: int) -> None:
        """Pause where the tests hide too little."""
        self._trial += 1
        self._share = hidden / tested if tested else 0.0
        if self._trial >= TRIAL + self._kept and tested and self._share < WORTH:
            self._trial, self._pause, self._judged = 0, PAUSE, drawn
            self.hidden = np.zeros_like(self.hidden)
