"""The header of a model: fixed fields, then one JSON object (docs/format.md, Header).

A `Header` cannot be built with values that a file may not have, so whoever holds one need not check it again.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .attributes import MAX_ATTRIBUTES, Attribute, Schema
from .constants import Constant
from .errors import Corrupt, FormatError, NotAModel, Truncated, UnsupportedVersion
from .header_checks import check_attributes, check_counts, check_geometry
from .page import PAGE_HEADER, RECORD, SMALLEST_CLOUD

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

MAGIC = b"\x89LPC\r\n\x1a\n"
MAJOR, MINOR = 2, 0
HEADER_PROBE = 65536  # bytes of the first read: header, first page and first clouds
PART_SUFFIX = (
    ".present"  # of a file beside a copy of which only parts are here: it says which, and the copy is no model alone
)
MAX_TEXT = 49_152  # leaves a quarter of the probe to the first page and clouds

_OBJECTS = ("left_out", "rejected", "bits_per_sample", "attribute_bits")
_FIXED = struct.Struct("<8sHHIII")
_Bytes = bytes  # the field `bytes` of Header hides the builtin inside the class


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What a file says about itself; every field is a key of the JSON object (docs/format.md says what it means).

    Raises
    ------
    Corrupt
        If a value is one that no file may have.

    Attributes
    ----------
    page0 : int
        File offset of page 0 (of the file that was parsed, or of the one that `to_bytes` starts).
    digest_text : bytes
        The JSON text without the digest: what `compute_digest` hashes first.
    """

    digest: str = "0" * 32
    bytes: int
    samples: int
    nodes: int
    levels: int
    cloud_size: int
    page_nodes: int
    origin: tuple[float, float, float]
    step: float
    side: float
    bounds: tuple[float, float, float, float, float, float]
    spacing: float
    position_error: float
    attributes: Schema = ()
    constants: Mapping[str, Constant] = field(default_factory=dict)
    crs: str | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    rejected: Mapping[str, int] = field(default_factory=dict)
    bits_per_sample: Mapping[str, float] = field(default_factory=dict)
    attribute_bits: Mapping[str, float] = field(default_factory=dict)
    spacing_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0)
    seed: int = 0
    generator: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)
    """Keys of a later minor version: kept, not understood."""
    page0: int = field(init=False, compare=False)
    digest_text: _Bytes = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        check_counts(self)
        check_geometry(self)
        check_attributes(self)
        text = _dump(self.to_json())
        object.__setattr__(self, "digest_text", _without_digest(text, self.digest))
        _place_page0(self, len(text))

    @property
    def tag(self) -> _Bytes:
        """The build tag that every page repeats: the first 8 bytes of the digest."""
        return _Bytes.fromhex(self.digest)[:8]

    @property
    def pages(self) -> int:
        """Pages of the index."""
        return -(-self.nodes // self.page_nodes)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object."""
        entry: dict[str, Any] = dict(self.extra)
        for item in fields(self):
            if item.init and item.name != "extra":
                entry[item.name] = getattr(self, item.name)
        entry["attributes"] = [attribute.to_json() for attribute in self.attributes]
        entry["constants"] = {name: constant.to_json() for name, constant in self.constants.items()}
        for name in _OBJECTS:
            entry[name] = dict(entry[name])
        return entry

    def to_bytes(self) -> _Bytes:
        """Return the file up to page 0: the same values give the same bytes.

        Raises
        ------
        FormatError
            If the text is longer than a header may be.
        """
        text = _dump(self.to_json())
        if len(text) > MAX_TEXT:
            raise FormatError(f"header of {len(text)} bytes (at most {MAX_TEXT}): shorten crs or left_out")
        fixed = _FIXED.pack(MAGIC, MAJOR, MINOR, len(text), zlib.crc32(text), 0)
        return (fixed + text).ljust(_padded(len(text)), b"\0")


def parse_header(data: _Bytes | memoryview) -> Header:
    """Read the header from the first bytes of a file; what follows it is not looked at.

    Raises
    ------
    NotAModel
        If the magic is another.
    UnsupportedVersion
        If the major version is another.
    Truncated
        If `data` ends inside the header; its `needed` is the length of the file up to page 0.
    Corrupt
        If the checksum fails or a value cannot be true.
    """
    data = memoryview(data).cast("B")
    if bytes(data[: len(MAGIC)]) != MAGIC[: len(data)]:
        raise NotAModel("this is no .lpc file (the first bytes are not its magic); build one with `pointstream build`")
    if len(data) < _FIXED.size:
        raise Truncated(f"the file ends inside its header, after {len(data)} bytes", _FIXED.size)
    _, major, _, length, crc, _ = _FIXED.unpack_from(data)
    if major != MAJOR:
        what = "update it" if major > MAJOR else "build the model again, or read it with the program that built it"
        raise UnsupportedVersion(f"the file is of format version {major}, this program reads {MAJOR}: {what}")
    if length > MAX_TEXT:
        raise Corrupt(f"header: {length} bytes of text (at most {MAX_TEXT})")
    page0 = _padded(length)
    if len(data) < page0:
        raise Truncated(f"the file ends inside its header, after {len(data)} of {page0} bytes", page0)
    text = bytes(data[_FIXED.size : _FIXED.size + length])
    if zlib.crc32(text) != crc:
        raise Corrupt("header: checksum differs, the file is damaged")
    header = _from_json(_load(text))
    object.__setattr__(header, "digest_text", _without_digest(text, header.digest))
    _place_page0(header, length)  # another writer may space its JSON differently
    return header


def compute_digest(header: Header, records: Iterable[_Bytes | memoryview | NDArray[Any]]) -> str:
    """Compute the build id: BLAKE2b-128 over the JSON text without the digest, then over all node records in order.

    Parameters
    ----------
    header : Header
        Its `digest` plays no part.
    records : iterable of buffers
        Records (`lpc.page.RECORD`) of the nodes in order, in pieces of any length.
    """
    state = hashlib.blake2b(header.digest_text, digest_size=16)
    for piece in records:
        state.update(piece.tobytes() if isinstance(piece, np.ndarray) else piece)
    return state.hexdigest()


def seal(header: Header, records: NDArray[Any]) -> Header:
    """Fill in `nodes`, `bytes` and `digest`, which depend on the finished records and on the header's own length.

    Parameters
    ----------
    header : Header
        With any `bytes` and `digest` that pass.
    records : ndarray, (nodes,) RECORD
        Of all nodes, in order.
    """
    nodes = len(records)
    pages = -(-nodes // header.page_nodes)
    body = PAGE_HEADER * pages + RECORD.itemsize * nodes + int(records["size"].sum(dtype=np.uint64))
    while header.bytes != header.page0 + body or header.nodes != nodes:  # digits of `bytes` lengthen the header: once
        header = replace(header, bytes=header.page0 + body, nodes=nodes)
    return replace(header, digest=compute_digest(header, [records]))


def smallest_file(page0: int, nodes: int, page_nodes: int) -> int:
    """Length below which no file of so many nodes can be."""
    return page0 + -(-nodes // page_nodes) * PAGE_HEADER + nodes * (RECORD.itemsize + SMALLEST_CLOUD)


def _place_page0(header: Header, text_bytes: int) -> None:
    page0 = _padded(text_bytes)
    object.__setattr__(header, "page0", page0)
    floor = smallest_file(page0, header.nodes, header.page_nodes)
    if header.bytes < floor:
        raise Corrupt(
            f"header: {header.nodes} nodes need {floor} bytes or more, the file is said to have {header.bytes}"
        )


def _padded(text_bytes: int) -> int:
    return -(-(_FIXED.size + text_bytes) // 8) * 8


def _dump(entry: dict[str, Any]) -> _Bytes:
    return json.dumps(entry, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")


def _without_digest(text: _Bytes, digest: str) -> _Bytes:
    return text.replace(f'"digest":"{digest}",'.encode(), b"", 1)


def _load(text: _Bytes) -> dict[str, Any]:
    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    try:
        entry = json.loads(text.decode("utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise Corrupt("header: the text is not JSON") from error
    if not isinstance(entry, dict):
        raise Corrupt("header: the text is not a JSON object")
    return entry


def _from_json(entry: dict[str, Any]) -> Header:
    known = {item.name for item in fields(Header) if item.init and item.name != "extra"}
    entry = {"attribute_bits": {}, **entry}  # the first builders did not state it
    missing = sorted(known - entry.keys())
    if missing:
        raise Corrupt(f"header: {', '.join(missing)} missing")
    values = {name: entry[name] for name in known}
    for name in ("origin", "bounds", "spacing_ratio"):
        if not isinstance(values[name], list):
            raise Corrupt(f"header: {name} is not a list")
        values[name] = tuple(values[name])
    for name in ("constants", *_OBJECTS):
        if not isinstance(values[name], dict):
            raise Corrupt(f"header: {name} is not an object")
    listed = values["attributes"]
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        raise Corrupt("header: attributes is not a list of objects")
    values["attributes"] = tuple(Attribute.from_json(item) for item in listed[: MAX_ATTRIBUTES + 1])
    values["constants"] = {name: Constant.from_json(item) for name, item in values["constants"].items()}
    return Header(**values, extra={name: value for name, value in entry.items() if name not in known})
