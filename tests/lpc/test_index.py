from __future__ import annotations

import math
import struct
import tracemalloc
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.build import build_bytes
from oracles.surfaces import bumpy, torus
from strategies import FakeModel, fake_model, fake_models, levels_of, random_records
from support.frames import decoded_clouds

from lpc.cloud import Cloud
from lpc.codec import cloud_to_points, decode_cloud
from lpc.errors import Corrupt, FormatError, Truncated
from lpc.header import Header, compute_digest, parse_header
from lpc.index import IndexTree
from lpc.octahedral import decode_normals
from lpc.page import PAGE_HEADER, RECORD


def load_all(data: bytes) -> IndexTree:
    tree = IndexTree(parse_header(data))
    for page in range(tree.header.pages):
        tree.add_page(page, data[int(tree.page_offset[page]) :])
    return tree


def slow_children(records: np.ndarray) -> list[list[int]]:
    """Children by counting bits one node after another."""
    following, out = 1, []
    for bits in records["children"]:
        pair = [-1, -1]
        for side in (0, 1):
            if bits >> side & 1:
                pair[side] = following
                following += 1
        out.append(pair)
    return out


def check_against(tree: IndexTree, model: FakeModel) -> None:
    records, header = model.records, model.header
    children = slow_children(records)
    parent = [-1] * len(records)
    for node, pair in enumerate(children):
        for child in pair:
            if child >= 0:
                parent[child] = node
    assert tree.known.all()
    assert tree.linked.all()
    assert tree.children.tolist() == children
    assert tree.parent.tolist() == parent
    assert tree.level.tolist() == levels_of(records)
    for name in ("radius", "spacing", "samples", "subtree", "size", "crc"):
        assert (getattr(tree, name) == records[name]).all(), name
    assert tree.center == pytest.approx(np.array(header.origin) + records["center"] * (header.side / 2**32), abs=1e-9)
    none = records["cone_angle"] == 65535
    assert tree.cone_angle == pytest.approx(np.where(none, math.pi, records["cone_angle"] / 65534 * math.pi), abs=1e-6)
    assert tree.cone_axis == pytest.approx(decode_normals(records["cone_axis"], 8))
    place = header.page0
    for node in range(len(records)):
        if node % header.page_nodes == 0:
            place += PAGE_HEADER + RECORD.itemsize * min(header.page_nodes, len(records) - node)
        assert tree.cloud_range(node).start == place
        place = tree.cloud_range(node).stop
    assert place == len(model.data)


@given(fake_models())
def test_pages_in_order_make_the_tree(model: FakeModel) -> None:
    check_against(load_all(model.data), model)


@given(fake_models(), st.randoms(use_true_random=False))
def test_pages_in_any_order_that_can_be_found_make_the_same_tree(model: FakeModel, random: Any) -> None:
    tree = IndexTree(model.header)
    while not tree.page_loaded.all():
        reachable = np.flatnonzero((tree.page_offset > 0) & ~tree.page_loaded)
        page = int(random.choice(reachable.tolist()))
        assert tree.page_range(page).start == model.pages[page][0]
        assert tree.page_range(page).size == len(model.pages[page][1])
        tree.add_page(page, model.pages[page][1])
        # What is linked is a tree that hangs together, whatever is missing.
        linked = np.flatnonzero(tree.linked)[1:]
        assert tree.known[tree.parent[linked]].all()
        assert tree.linked[tree.parent[linked]].all()
        assert (tree.level[linked] == tree.level[tree.parent[linked]] + 1).all()
    check_against(tree, model)


def test_only_the_path_to_a_node_has_to_be_read() -> None:
    rng = np.random.default_rng(1)
    model = fake_model(random_records([3] * 511, rng), 8, rng)  # ten full levels
    tree = IndexTree(model.header)
    loaded, node = 0, 0
    while True:
        for page in tree.missing_pages([node]):
            tree.add_page(int(page), model.data[tree.page_range(int(page)).start :])
            loaded += 1
        assert tree.missing_pages([node]).size == 0
        if tree.children[node, 1] < 0:
            break
        node = int(tree.children[node, 1])
    assert tree.level[node] == 9
    assert loaded < 10
    assert tree.known.sum() <= 8 * loaded  # the last page is shorter


def test_missing_pages_are_named_once_and_only_where_they_can_be_read() -> None:
    rng = np.random.default_rng(1)
    model = fake_model(random_records([3] * 31, rng), 4, rng)
    tree = IndexTree(model.header)
    assert tree.missing_pages([0, 1, 2]).tolist() == [0]
    assert tree.missing_pages([40]).size == 0
    tree.add_page(0, model.pages[0][1])
    assert tree.missing_pages([0, 4, 5, 7, 8, 40]).tolist() == [1, 2][: len(tree.missing_pages([4, 8]))]
    with pytest.raises(FormatError, match="cannot be found yet"):
        tree.page_range(9)
    with pytest.raises(FormatError, match="cannot be found yet"):
        tree.add_page(9, model.pages[9][1])
    with pytest.raises(FormatError, match="not known"):
        tree.cloud_range(40)


def test_a_page_that_has_come_is_not_read_again() -> None:
    rng = np.random.default_rng(1)
    model = fake_model(random_records([3] * 7, rng), 4, rng)
    tree = IndexTree(model.header)
    tree.add_page(0, model.pages[0][1])
    tree.add_page(0, b"")
    assert tree.known.sum() == 4


@given(fake_models(max_nodes=60), st.data())
def test_a_refused_page_changes_nothing_and_the_true_one_still_fits(model: FakeModel, data: Any) -> None:
    tree = IndexTree(model.header)
    for number, (_, packed) in enumerate(model.pages):
        offset = data.draw(st.integers(8, len(packed) - 1))
        wrong = bytearray(packed)
        value = data.draw(st.binary(min_size=1, max_size=4))[: len(packed) - offset]
        wrong[offset : offset + len(value)] = value
        struct.pack_into("<I", wrong, 20, zlib.crc32(wrong[24:], zlib.crc32(wrong[:20])))
        before = (tree.known.copy(), tree.linked.copy(), tree.page_offset.copy(), tree.page_loaded.copy())
        try:
            tree.add_page(number, bytes(wrong))
        except FormatError:
            now = (tree.known, tree.linked, tree.page_offset, tree.page_loaded)
            assert all((old == new).all() for old, new in zip(before, now, strict=True))
            tree.add_page(number, packed)
        else:
            return  # a change that no check can see, such as another radius
    check_against(tree, model)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1)])
def test_a_child_far_from_its_parent_is_refused_with_whichever_page_comes_last(order: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    records = random_records([3] * 7, rng)
    records["center"], records["radius"] = 2**31, 1.0
    records["center"][12], records["radius"][12] = 0, 0.1
    model = fake_model(records, 5, rng)
    tree = IndexTree(model.header)
    for page in order[:-1]:
        tree.add_page(page, model.pages[page][1])
    with pytest.raises(Corrupt, match="sphere of node 12"):
        tree.add_page(order[-1], model.pages[order[-1]][1])


def lie(model: FakeModel, page: int, field: str, row: int, value: int) -> bytes:
    packed = bytearray(model.pages[page][1])
    records = np.frombuffer(packed, RECORD, offset=PAGE_HEADER)
    records[field][row] = value
    struct.pack_into("<I", packed, 20, zlib.crc32(packed[24:], zlib.crc32(packed[:20])))
    return bytes(packed)


def full_tree(page_nodes: int = 4) -> FakeModel:
    rng = np.random.default_rng(3)
    return fake_model(random_records([3] * 15, rng), page_nodes, rng)


def test_samples_that_do_not_add_up_are_found_across_pages() -> None:
    model = full_tree()
    tree = IndexTree(model.header)
    tree.add_page(0, model.pages[0][1])
    node = 4  # a child of node 1, which page 0 describes
    assert tree.parent[node] == 1
    lying = lie(model, 1, "subtree", 0, int(model.records["subtree"][node]) + 1)
    with pytest.raises(Corrupt, match="do not add up"):
        tree.add_page(1, lying)


def test_the_root_holds_all_samples() -> None:
    model = full_tree(page_nodes=1)
    with pytest.raises(Corrupt, match="header says"):
        IndexTree(model.header).add_page(0, lie(model, 0, "subtree", 0, int(model.records["subtree"][0]) - 1))


def test_clouds_end_where_the_next_page_starts() -> None:
    model = full_tree()
    tree = IndexTree(model.header)
    with pytest.raises(Corrupt, match=r"page 1 cannot be|clouds end"):
        tree.add_page(0, lie(model, 0, "size", 3, int(model.records["size"][3]) + 1))
    last = len(model.pages) - 1
    for page in range(last):
        tree.add_page(page, model.pages[page][1])
    with pytest.raises(Corrupt, match="clouds end"):
        tree.add_page(last, lie(model, last, "size", 0, int(model.records["size"][4 * last]) + 1))


def test_a_chain_deeper_than_the_header_says_is_found() -> None:
    rng = np.random.default_rng(3)
    model = fake_model(random_records([1] * 10, rng), 4, rng)
    shallow = replace(model.header, levels=10)
    tree = IndexTree(shallow)
    tree.add_page(0, model.pages[0][1])
    tree.add_page(1, model.pages[1][1])
    with pytest.raises(Corrupt, match="deeper"):
        tree.add_page(2, model.pages[2][1])


def test_a_child_before_its_parent_is_found() -> None:
    rng = np.random.default_rng(3)
    model = fake_model(random_records([1, 1, 1], rng), 4, rng)
    packed = bytearray(model.pages[0][1])
    records = np.frombuffer(packed, RECORD, offset=PAGE_HEADER)
    records["children"] = [1, 0, 1, 1]  # node 2 would be its own child
    records["samples"] = 1
    records["subtree"] = [model.header.samples, 1, 3, 2]
    struct.pack_into("<I", packed, 20, zlib.crc32(packed[24:], zlib.crc32(packed[:20])))
    with pytest.raises(Corrupt, match="before its parent"):
        IndexTree(model.header).add_page(0, bytes(packed))


def test_a_lying_header_costs_no_memory() -> None:
    header = parse_header(full_tree().data)
    nodes = 2**24
    with pytest.raises(Corrupt, match="bytes or more"):
        replace(header, nodes=nodes, samples=2**40)
    liar = replace(header, nodes=nodes, samples=2**40, bytes=2**50)

    def resident() -> int:
        with open("/proc/self/statm") as statm:  # noqa: PTH123
            return int(statm.read().split()[1]) * 4096

    before = resident()
    tree = IndexTree(liar)
    assert len(tree) == nodes
    assert resident() - before < 2**24
    assert not tracemalloc.is_tracing()


def cut_model(data: bytes, length: int) -> IndexTree | None:
    """What a reader of the first `length` bytes does: every page that ends inside."""
    prefix = data[:length]
    try:
        tree = IndexTree(parse_header(prefix))
    except Truncated:
        return None
    for page in range(tree.header.pages):
        if tree.page_offset[page] == 0 or tree.page_range(page).stop > length:
            break
        tree.add_page(page, prefix[tree.page_range(page).start :])
    return tree


@pytest.mark.parametrize("cloud_size", [40, 64])
def test_any_prefix_is_a_complete_coarser_model(cloud_size: int) -> None:
    points = torus(1500, color=True)
    data = build_bytes(points, cloud_size=cloud_size, page_nodes=5)
    whole = load_all(data)
    ends = whole.offset + whole.size
    rng = np.random.default_rng(7)
    cuts = {0, 23, 24, whole.header.page0 - 1, whole.header.page0, len(data) - 1, len(data)}
    cuts |= {int(end) + by for end in ends[::3] for by in (-1, 0, 1)} | set(rng.integers(0, len(data), 60).tolist())
    seen: dict[int, Cloud] = {}
    for length in sorted(cuts):
        tree = cut_model(data, min(length, len(data)))
        if tree is None:
            assert length < whole.header.page0
            continue
        here = tree.available(length)
        assert here.tolist() == (ends <= length).tolist()  # a page stands before its clouds, so nothing is lost
        below = here.copy()
        below[0] = False
        assert here[tree.parent[below]].all()  # a parent comes before its children: it is a tree
        for node in np.flatnonzero(here):
            place = tree.cloud_range(int(node))
            frame = data[:length][place.start : place.stop]
            assert zlib.crc32(frame) == tree.crc[node]
            if node not in seen:
                line, above = [], int(tree.parent[node])
                while above >= 0:
                    line.append(seen[above])
                    above = int(tree.parent[above])
                samples, schema, context = int(tree.samples[node]), tree.header.attributes, line[::-1]
                seen[int(node)] = decode_cloud(frame, samples=samples, schema=schema, context=context)
        for page in np.flatnonzero(~tree.page_loaded & (tree.page_offset > 0)):
            with pytest.raises(Truncated):
                tree.add_page(int(page), data[int(tree.page_offset[page]) : length])
    assert sum(map(len, seen.values())) == len(points)


def test_an_oracle_built_file_holds_exactly_its_input() -> None:
    points = bumpy(2000, color=True, seed=3)
    data = build_bytes(points, cloud_size=100, page_nodes=6, seed=2)
    tree = load_all(data)
    header: Header = tree.header
    assert compute_digest(header, [b"".join(records(data, tree))]) == header.digest
    decoded = [cloud_to_points(cloud, header) for cloud in decoded_clouds(data)]
    # The clouds of a subtree lie in its sphere and its cone, as decoded.
    for node in range(header.nodes):
        above = node
        while above >= 0:
            xyz, normal = decoded[node].xyz, decoded[node].normal
            assert normal is not None
            assert np.linalg.norm(xyz - tree.center[above], axis=1).max() <= tree.radius[above]
            cosine = (normal.astype(float) @ tree.cone_axis[above].astype(float)).min()
            assert math.acos(np.clip(cosine, -1, 1)) <= tree.cone_angle[above] + 1e-6
            above = int(tree.parent[above])
    xyz = np.concatenate([part.xyz for part in decoded])
    order, wanted = np.lexsort(np.round(xyz, 9).T), points.xyz
    # Same multiset within the bound: match through the lattice, which both sides share.
    key = lambda values: np.rint((values - np.array(header.origin)) / header.step).astype(int)  # noqa: E731
    assert sorted(map(tuple, key(wanted))) == sorted(map(tuple, key(xyz[order])))


def records(data: bytes, tree: IndexTree) -> list[bytes]:
    places = [tree.page_range(page) for page in range(tree.header.pages)]
    return [data[place.start + PAGE_HEADER : place.stop] for place in places]
