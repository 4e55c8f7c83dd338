"""The access layer while a host changes the model: never a mixture, and no trust in tags that lie."""

from __future__ import annotations

import asyncio
import zlib
from dataclasses import replace
from typing import TYPE_CHECKING

from support.frames import FRAME, check_clouds, fill, frame, whole_index
from support.hosts import PATH
from support.layers import over_line

from lpc.header import HEADER_PROBE, parse_header
from pointlink.faults import OtherEtag
from pointlink.resources import Resource

if TYPE_CHECKING:
    from pointlink.origin import Origin
    from pointstream.layer import AccessLayer


def test_a_new_build_takes_the_place_of_the_old_one_in_one_step(model: bytes, other_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        frame(layer)
        await asyncio.sleep(FRAME)
        origin.resources[PATH] = Resource.from_bytes(other_model)  # type: ignore[index]
        digests = {parse_header(model).digest: model, parse_header(other_model).digest: other_model}
        for _ in range(200):
            frame(layer)
            check_clouds(layer, digests[layer.header.digest])
            await asyncio.sleep(FRAME)
        assert layer.header == parse_header(other_model)
        assert layer.resident.all()
        assert len(layer.resident) == layer.header.nodes
        assert layer.stats.build == 2
        assert [report.cause for report in layer.stats.errors] == ["model"]

    over_line(model, check)


def test_a_new_build_of_equal_length_and_tag_is_found_by_its_pages(model: bytes) -> None:
    """nginx and Caddy give such twins the same tag: the build tag of the next page tells them apart."""
    header = parse_header(model)
    twin_header = replace(header, digest=header.digest[::-1])
    index = whole_index(model)
    twin = bytearray(twin_header.to_bytes() + model[header.page0 :])
    assert len(twin) == len(model)
    for page in range(len(index.page_loaded)):
        start, stop = index.page_range(page).start, index.page_range(page).stop
        twin[start : start + 8] = twin_header.tag
        crc = zlib.crc32(twin[start + 24 : stop], zlib.crc32(twin[start : start + 20]))
        twin[start + 20 : start + 24] = crc.to_bytes(4, "little")

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        old = origin.resources[PATH]
        origin.resources[PATH] = replace(old, read=lambda a, b: bytes(twin[a:b]))  # type: ignore[index]
        await fill(layer)
        assert layer.header.digest == twin_header.digest
        assert layer.resident.all()
        assert layer.stats.build == 2

    over_line(model, check)


def test_tags_that_change_with_every_reply_are_not_trusted_for_long(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        assert layer.resident.all()
        assert layer.stats.build == 1
        assert len([exchange for exchange in origin.log if exchange.stop == HEADER_PROBE]) == 2

    over_line(model, check, fault=lambda number: OtherEtag(etag=f'"{number}"'))


def test_a_host_that_changes_for_ever_is_given_up(model: bytes, other_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        turn = 0

        def swap(number: int) -> None:
            nonlocal turn
            turn += 1
            data = (model, other_model)[turn % 2]
            origin.resources[PATH] = Resource.from_bytes(data)  # type: ignore[index]

        origin.fault = swap  # type: ignore[assignment]
        for _ in range(300):
            frame(layer)
            await asyncio.sleep(FRAME)
        assert [report.cause for report in layer.stats.errors][-1] == "host"
        assert len(origin.log) < 60

    over_line(model, check)
