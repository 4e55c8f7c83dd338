"""The index tree as arrays, filled page by page while they arrive (docs/format.md, Page)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .bounds import decode_centers, decode_cones
from .density import Density
from .errors import Corrupt, FormatError
from .page import PAGE_HEADER, RECORD, SMALLEST_CLOUD, Page, child_counts, child_page_numbers, page_bytes, parse_page
from .ranges import ByteRange

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from .header import Header


class IndexTree:
    """All nodes of a model; a row is valid where `known` is true, and zero where nothing is known yet.

    The arrays have one row per node of the header, but memory is only touched for pages that have come (a header
    that lies about its nodes costs nothing). A page can be added as soon as its offset is known: that of page 0
    from the header, that of any other from a page that holds a parent of its nodes, or from the page before it.
    Nothing changes when a page is refused.

    Attributes
    ----------
    known : ndarray, (nodes,) bool
        The node's record has come.
    linked : ndarray, (nodes,) bool
        `parent` and `level` are valid: all ancestors have come. True for the children of linked known nodes.
    center : ndarray, (nodes, 3) float64
        Bounding sphere of the subtree, model units, absolute.
    radius, spacing : ndarray, (nodes,) float64
        Model units.
    samples, subtree : ndarray, (nodes,) int64
        Samples of the cloud, and of the node with its descendants.
    offset, size : ndarray, (nodes,) int64
        Where the cloud stands in the file.
    crc : ndarray, (nodes,) uint32
        CRC-32 of the cloud's bytes.
    cone_axis : ndarray, (nodes, 3) float32
        Unit axis of the cone of normals.
    cone_angle : ndarray, (nodes,) float32
        Its half angle in radians; pi: no cone.
    children : ndarray, (nodes, 2) int32
        Numbers of the children, -1: none.
    parent : ndarray, (nodes,) int32
        -1 for the root.
    level : ndarray, (nodes,) uint8
        0 for the root.
    page_offset : ndarray, (pages,) int64
        0 where it is not known yet.
    page_loaded : ndarray, (pages,) bool
    density : Density
        How even the scan is, of nodes that are known and linked.
    """

    def __init__(self, header: Header) -> None:
        self.header = header
        nodes, pages = header.nodes, header.pages
        try:
            self.known = np.zeros(nodes, bool)
            self.linked = np.zeros(nodes, bool)
            self.center = np.zeros((nodes, 3))
            self.radius = np.zeros(nodes)
            self.spacing = np.zeros(nodes)
            self.samples = np.zeros(nodes, np.int64)
            self.subtree = np.zeros(nodes, np.int64)
            self.offset = np.zeros(nodes, np.int64)
            self.size = np.zeros(nodes, np.int64)
            self.crc = np.zeros(nodes, np.uint32)
            self.cone_axis = np.zeros((nodes, 3), np.float32)
            self.cone_angle = np.zeros(nodes, np.float32)
            self.children = np.zeros((nodes, 2), np.int32)
            self.parent = np.zeros(nodes, np.int32)
            self.level = np.zeros(nodes, np.uint8)
            self.page_offset = np.zeros(pages, np.int64)
            self.page_loaded = np.zeros(pages, bool)
            self.density = Density(nodes)
            self._has_parent = np.zeros(nodes, bool)
            self._first_child = np.zeros(pages + 1, np.int64)
        except MemoryError as error:
            raise Corrupt(f"header: an index of {nodes} nodes does not fit into memory") from error
        self.page_offset[0] = header.page0
        self._first_child[0], self._first_child[pages] = 1, nodes
        self.parent[0] = -1
        self.linked[0] = self._has_parent[0] = True

    def __repr__(self) -> str:
        return f"<IndexTree {int(self.page_loaded.sum())} of {len(self.page_loaded)} pages, {self.header.nodes} nodes>"

    def __len__(self) -> int:
        return self.header.nodes

    def add_page(self, page: int, data: bytes | memoryview) -> None:
        """Read a page; one that has come before is not read again.

        Parameters
        ----------
        page : int
            Its number.
        data : bytes
            The file from the page's offset on, at least `page_range(page)`.

        Raises
        ------
        FormatError
            If the page's offset is not known yet.
        Truncated, Corrupt
            If the page is incomplete, damaged, or contradicts the header or another page.
        """
        if self.page_loaded[page]:
            return
        offset = self._offset_of(page)
        parsed = parse_page(data, self.header, page)
        first, stop = parsed.first_node, parsed.first_node + len(parsed.records)
        kids = self._children_of(page, parsed)
        end, found = self._pages_after(page, offset, parsed, len(kids))
        # Rows that are not `known` may hold anything, so they are written before the last checks.
        self._write_rows(offset, parsed)
        self._check_subtrees(page, first, stop)
        self._check_spheres(page, first, stop)
        levels = self._levels_below(page, first, stop)
        # Nothing fails from here on.
        self.known[first:stop] = True
        self.page_loaded[page] = True
        self._first_child[page] = parsed.first_child
        if page + 1 < len(self.page_loaded):
            self._first_child[page + 1] = parsed.first_child + len(kids)
            self.page_offset[page + 1] = end
        for number, place in found:
            self.page_offset[number] = place
        self.parent[kids] = np.repeat(np.arange(first, stop), child_counts(parsed.records))
        self._has_parent[kids] = True
        for nodes, level in levels:
            self.level[nodes] = level
            self.linked[nodes] = True
        own = np.arange(first, stop)
        fresh = np.unique(np.concatenate([own[self.linked[first:stop]], *(nodes for nodes, _ in levels)]))
        fresh = fresh[self.known[fresh]]
        depth = self.level[fresh]
        self.density.add(self, [fresh[depth == level] for level in np.unique(depth)])

    def missing_pages(self, nodes: ArrayLike) -> NDArray[np.int64]:
        """Pages that hold some of these nodes, have not come, and whose offsets are known; each once, in order."""
        pages = np.unique(np.asarray(nodes, dtype=np.int64) // self.header.page_nodes)
        return pages[~self.page_loaded[pages] & (self.page_offset[pages] > 0)]

    def page_range(self, page: int) -> ByteRange:
        """Where a page stands; FormatError if it is not known yet."""
        offset = self._offset_of(page)
        return ByteRange(offset, offset + page_bytes(self.header, page))

    def cloud_range(self, node: int) -> ByteRange:
        """Where the cloud of a known node stands."""
        if not self.known[node]:
            raise FormatError(f"node {node} is not known yet: its page has not come")
        return ByteRange(int(self.offset[node]), int(self.offset[node] + self.size[node]))

    def available(self, length: int) -> NDArray[np.bool_]:
        """Known nodes whose clouds end within the first `length` bytes of the file: what a file cut short still has."""
        return self.known & (self.offset + self.size <= length)

    def _offset_of(self, page: int) -> int:
        offset = int(self.page_offset[page])
        if offset == 0:
            raise FormatError(f"page {page} cannot be found yet: no page that names it has come")
        return offset

    def _children_of(self, page: int, parsed: Page) -> NDArray[np.int64]:
        """Numbers of the children of a page's nodes; checks that no other page has them."""
        total = int(child_counts(parsed.records).sum())
        for number, expected in ((page, parsed.first_child), (page + 1, parsed.first_child + total)):
            if self._first_child[number] not in (0, expected):
                raise Corrupt(f"page {page}: its children do not continue those of the page before or after")
        kids = np.arange(parsed.first_child, parsed.first_child + total)
        if self._has_parent[kids].any():
            raise Corrupt(f"page {page}: one of its children has another parent")
        return kids

    def _pages_after(self, page: int, offset: int, parsed: Page, kids: int) -> tuple[int, list[tuple[int, int]]]:
        """Where the page's clouds end, and (number, offset) of the pages that it names."""
        header = self.header
        end = offset + page_bytes(header, page) + int(parsed.records["size"].sum(dtype=np.int64))
        last = page + 1 == len(self.page_loaded)
        if (
            end > header.bytes
            or (last and end != header.bytes)
            or (not last and self.page_offset[page + 1] not in (0, end))
        ):
            raise Corrupt(
                f"page {page}: its clouds end at {end}, where neither the next page nor the file's end can be"
            )
        full = PAGE_HEADER + header.page_nodes * (RECORD.itemsize + SMALLEST_CLOUD)
        found = []
        numbers = child_page_numbers(page, parsed.first_child, kids, header.page_nodes)
        for number, place in zip(numbers, parsed.child_pages, strict=True):
            if number < 0:
                continue
            between = number - page - 1
            possible = place >= end + between * full and place + page_bytes(header, number) <= header.bytes
            if not possible or (between == 0 and place != end) or self.page_offset[number] not in (0, place):
                raise Corrupt(f"page {page}: page {number} cannot be at {place}")
            found.append((number, place))
        return end, found

    def _write_rows(self, offset: int, parsed: Page) -> None:
        records = parsed.records
        rows = slice(parsed.first_node, parsed.first_node + len(records))
        sizes = records["size"].astype(np.int64)
        clouds = offset + PAGE_HEADER + RECORD.itemsize * len(records)
        self.center[rows] = decode_centers(records["center"], self.header.origin, self.header.side)
        self.radius[rows] = records["radius"]
        self.spacing[rows] = records["spacing"]
        self.samples[rows] = records["samples"]
        self.subtree[rows] = records["subtree"]
        self.offset[rows] = clouds + np.cumsum(sizes) - sizes
        self.size[rows] = sizes
        self.crc[rows] = records["crc"]
        self.cone_axis[rows], self.cone_angle[rows] = decode_cones(records["cone_axis"], records["cone_angle"])
        counts = child_counts(records)
        place = parsed.first_child + np.cumsum(counts) - counts
        lower, upper = records["children"] & 1, records["children"] >> 1
        self.children[rows, 0] = np.where(lower, place, -1)
        self.children[rows, 1] = np.where(upper, place + lower, -1)

    def _check_subtrees(self, page: int, first: int, stop: int) -> None:
        """Check that children come after their parents and that samples add up wherever both are here now."""
        own = np.arange(first, stop)
        children = self.children[first:stop]
        if ((children >= 0) & (children <= own[:, None])).any():
            raise Corrupt(f"page {page}: a child comes before its parent")
        if first == 0 and self.subtree[0] != self.header.samples:
            raise Corrupt(f"page 0: the tree has {self.subtree[0]} samples, the header says {self.header.samples}")
        here = self._has_parent[first:stop]
        above = np.unique(self.parent[first:stop][here])
        above = above[above >= 0]
        for nodes in (own[children.max(axis=1) >= 0], above):
            below = self.children[nodes]
            come = (below < 0) | self.known[below] | ((below >= first) & (below < stop))
            nodes, below = nodes[come.all(axis=1)], below[come.all(axis=1)]
            total = np.where(below >= 0, self.subtree[below], 0).sum(axis=1)
            wrong = total != self.subtree[nodes] - self.samples[nodes]
            if wrong.any():
                raise Corrupt(f"page {page}: samples below node {nodes[np.argmax(wrong)]} do not add up")

    def _check_spheres(self, page: int, first: int, stop: int) -> None:
        """Check that the spheres of parents and children meet: both hold the samples of the child's subtree."""
        own = np.arange(first, stop)
        below = self.children[first:stop]
        come = (below >= 0) & (self.known[below] | ((below >= first) & (below < stop)))
        linked = own[self._has_parent[first:stop] & (self.parent[first:stop] >= 0)]
        parents = np.concatenate([np.repeat(own, come.sum(axis=1)), self.parent[linked]])
        children = np.concatenate([below[come], linked])
        away = np.sqrt(((self.center[parents] - self.center[children]) ** 2).sum(axis=1))
        slack = 1e-6 * self.header.side + 1e-12 * np.abs(self.center[parents]).max(initial=0.0)
        apart = away > self.radius[parents] + self.radius[children] + slack
        if apart.any():
            raise Corrupt(f"page {page}: the sphere of node {children[np.argmax(apart)]} is nowhere near its parent's")

    def _levels_below(self, page: int, first: int, stop: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Levels that become known through this page: mostly of its children, deeper where pages below came first."""
        nodes = np.arange(first, stop)[self.linked[first:stop]]
        levels = self.level[nodes].astype(np.int64)
        found = []
        while len(nodes):
            children = self.children[nodes]
            exists = children >= 0
            nodes, levels = children[exists].astype(np.int64), np.repeat(levels + 1, exists.sum(axis=1))
            if len(levels) and levels.max() >= self.header.levels:
                raise Corrupt(f"page {page}: a node is deeper than the {self.header.levels} levels of the header")
            found.append((nodes, levels))
            come = self.known[nodes] | ((nodes >= first) & (nodes < stop))
            nodes, levels = nodes[come], levels[come]
        return found
