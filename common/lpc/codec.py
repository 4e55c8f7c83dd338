"""One cloud to bytes and back: the zstd frame around the payload (docs/format.md, Cloud).

Encoding is a pure function of the set of samples. Decoding trusts nothing: what a frame declares is bounded
before anything is allocated, and only `Corrupt` comes out of a bad one.
"""

from __future__ import annotations

import itertools
import math
import threading
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import zstandard

from .channels import Channels, channels_of, from_channels, to_channels
from .cloud import Cloud
from .errors import Corrupt
from .lattice import dequantise
from .octahedral import decode_normals
from .payload import (
    MAX_SAMPLES,
    ORIGIN_LIMIT,
    RAW_BITS,
    Layout,
    Packed,
    Unpacked,
    largest_payload,
    pack_header,
    parse_layout,
)
from .points import PointBatch

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from .attributes import Schema
    from .header import Header

Effort = Literal["default", "best", "fast"]
Engine = Literal["auto", "numpy", "compiled"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Limits:
    """What an effort spends on a cloud.

    Parameters
    ----------
    window : int
        Previous samples that predict an attribute: with 16 a cloud takes 0.8 % more and decodes 1.7 times as fast.
    hard : float
        Bits a sample of position and normal above which planes are tried.
    gain : float
        Bits a sample that planes must save to be kept: a cloud with planes takes twice as long to decode.
    """

    window: int
    hard: float
    gain: float


LIMITS: dict[Effort, _Limits] = {
    "default": _Limits(window=64, hard=20.5, gain=0.25),
    "best": _Limits(window=64, hard=0.0, gain=0.0),
    "fast": _Limits(window=16, hard=math.inf, gain=0.0),
}

SMALL = 1024
"""Samples of a cloud whose blocks zstd takes for small."""
ZSTD_MAGIC = bytes.fromhex("28b52ffd")
MAX_FRAME_WINDOW = 1 << 27
"""What zstd itself takes as the most that a frame may ask of a reader."""


class _Codec(Protocol):
    """What `codec_numpy` and `codec_compiled` both are."""

    def encode(
        self,
        lattice: NDArray[np.int64],
        rows: NDArray[np.uint32],
        begin: int,
        end: int,
        channels: Channels,
        window: int,
        planes: bool = False,
    ) -> Packed: ...

    def decode(self, payload: bytes, layout: Layout, channels: Channels) -> Unpacked: ...

    def turn_back(self, rows: NDArray[np.uint32], channels: Channels, turn: int) -> None: ...


@cache
def _codec(engine: Engine) -> _Codec:
    if engine == "compiled" or (engine == "auto" and find_spec("numba")):
        from . import codec_compiled

        return codec_compiled
    if engine not in ("auto", "numpy"):
        raise ValueError(f"engine {engine!r} is none of auto, numpy, compiled")
    from . import codec_numpy

    return codec_numpy


class _Contexts(threading.local):
    """zstd contexts of one thread: costly to make and not safe to share."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()
        self.compressors: dict[Effort, zstandard.ZstdCompressor] = {}

    def compressor(self, effort: Effort) -> zstandard.ZstdCompressor:
        if effort not in self.compressors:
            self.compressors[effort] = zstandard.ZstdCompressor(compression_params=_parameters(effort))
        return self.compressors[effort]


_contexts = _Contexts()


def _parameters(effort: Effort) -> zstandard.ZstdCompressionParameters:
    """Return the encoder settings. Matches shorter than 7 bytes cost more than they save in streams of tokens."""
    if effort == "best":
        return zstandard.ZstdCompressionParameters.from_level(19, min_match=7, write_checksum=True)
    if effort == "fast":
        return zstandard.ZstdCompressionParameters.from_level(
            1, min_match=7, strategy=zstandard.STRATEGY_FAST, write_checksum=True
        )
    return zstandard.ZstdCompressionParameters.from_level(
        6, min_match=7, strategy=zstandard.STRATEGY_LAZY, write_checksum=True
    )


def encode_cloud(
    lattice: NDArray[np.int64],
    codes: Mapping[str, NDArray[Any]],
    schema: Schema,
    *,
    effort: Effort = "default",
    engine: Engine = "auto",
) -> bytes:
    """Pack the samples of one node.

    Parameters
    ----------
    lattice : ndarray, (k, 3) int64
        Lattice coordinates; 1 <= k <= 2**20, the cloud's extent below 2**48, any order.
    codes : mapping of str to ndarray
        Codes by attribute name: normals (k, 2), colours (k, 3), scalars (k,).
    schema : Schema
        The attributes that are written, in that order.
    effort : {"default", "best", "fast"}
        Normals predicted by planes take about 0.7 bits a sample less, but such a cloud takes twice as long to decode
        and four times as long to encode. "best" tries planes on every cloud and lets zstd search longer. "default"
        tries them where position and normal take more than 20.5 bits a sample, and keeps them where they save 0.25.
        "fast" never tries them, looks at fewer neighbours and lets zstd search less (docs/format.md, Choices of a
        writer).

    Returns
    -------
    bytes
        A zstd frame. The order of the samples makes no difference to it.

    Raises
    ------
    ValueError
        If arguments are out of these ranges.
    """
    return encode_clouds(lattice, codes, np.array([0, len(lattice)]), schema, effort=effort, engine=engine)[0]


def encode_clouds(
    lattice: NDArray[np.int64],
    codes: Mapping[str, NDArray[Any]],
    bounds: NDArray[np.int64],
    schema: Schema,
    *,
    effort: Effort = "default",
    engine: Engine = "auto",
) -> list[bytes]:
    """Pack many clouds that stand one after another: cloud `i` is samples ``bounds[i]`` to ``bounds[i + 1]``.

    The same frames as one call of `encode_cloud` each, for less: what numpy does is done once.
    """
    channels = channels_of(schema)
    lattice = np.ascontiguousarray(lattice, np.int64)
    edges = np.asarray(bounds).tolist()
    for begin, end in itertools.pairwise(edges):
        if not 1 <= end - begin <= MAX_SAMPLES or not 0 <= begin < end <= len(lattice):
            raise ValueError(f"a cloud of samples {begin} to {end} of {len(lattice)}: 1 to {MAX_SAMPLES} are allowed")
    if len(lattice) and (lattice.min() <= -ORIGIN_LIMIT or lattice.max() >= ORIGIN_LIMIT):
        raise ValueError("lattice coordinates must stay below 2**52")
    rows = to_channels(codes, schema, len(lattice))
    encode = _codec(engine).encode
    limits = LIMITS[effort]
    compressor = _contexts.compressor(effort)
    # Faster strategies reuse another stream's Huffman codes in blocks up to 1 KiB, which takes up to 20 % more.
    small = _contexts.compressor("default" if effort == "fast" else effort)
    frames = []
    for begin, end in itertools.pairwise(edges):
        chosen = small if end - begin <= SMALL else compressor
        frame, bits = _frame(encode(lattice, rows, begin, end, channels, limits.window), channels, chosen)
        if len(channels.normals) and bits > limits.hard * (end - begin):
            packed = encode(lattice, rows, begin, end, channels, limits.window, planes=True)
            if packed.grid:
                other, _ = _frame(packed, channels, chosen)
                if 8 * (len(frame) - len(other)) > limits.gain * (end - begin):
                    frame = other
        frames.append(frame)
    return frames


def _frame(packed: Packed, channels: Channels, compressor: zstandard.ZstdCompressor) -> tuple[bytes, int]:
    """Compress a payload with a block for each kind of number, so that each has Huffman codes of its own.

    Returns the frame, and the bits of it that are not other channels than normals.
    """
    if packed.nbits > 16 or packed.shift > 32:
        raise ValueError(f"a cloud spans 2**{packed.nbits + packed.shift} steps, 2**48 are the most")
    head = pack_header(packed) + packed.raw.tobytes()
    stream = compressor.compressobj(size=len(head) + packed.tokens.size)
    parts = [stream.compress(head) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    runs = ((-1, 0), *channels.groups)
    normal = {first for first, _ in channels.normals.tolist()} | {-1}
    others = 0
    for first, stop in runs:
        tokens = packed.tokens[1 + first : 1 + stop]
        end = zstandard.COMPRESSOBJ_FLUSH_FINISH if stop == len(channels) else zstandard.COMPRESSOBJ_FLUSH_BLOCK
        parts.append(stream.compress(tokens.data) + stream.flush(end))
        if first not in normal:
            others += 8 * len(parts[-1]) + int(RAW_BITS[tokens].sum(dtype=np.int64))
    frame = b"".join(parts)
    return frame, 8 * len(frame) - others


def decode_cloud(frame: bytes, *, samples: int, schema: Schema, engine: Engine = "auto") -> Cloud:
    """Unpack a cloud.

    Parameters
    ----------
    frame : bytes
        As `encode_cloud` gave it, or anything.
    samples : int
        How many samples the node's record promises.
    schema : Schema
        The header's attributes.
    engine : {"auto", "numpy", "compiled"}
        "auto" takes the compiled kernels if numba is installed. The arrays are the same.

    Raises
    ------
    Corrupt
        If the frame is not a cloud of so many samples. Nothing else is raised, whatever the bytes are.
    """
    if not 1 <= samples <= MAX_SAMPLES:
        raise Corrupt(f"cloud: a record of {samples} samples (1 to {MAX_SAMPLES} are allowed)")
    channels = channels_of(schema)
    payload = _payload(frame, largest_payload(samples, channels))
    layout = parse_layout(payload, samples=samples, channels=channels)
    codec = _codec(engine)
    unpacked = codec.decode(payload, layout, channels)
    if unpacked.largest >> (3 * layout.nbits):
        raise Corrupt(f"cloud: its positions leave {layout.nbits} bits")
    for first, centre in channels.normals.tolist():
        if unpacked.rows[first : first + 2].max() > 2 * centre:
            raise Corrupt("cloud: a code is no normal's")
    if layout.turn:
        codec.turn_back(unpacked.rows, channels, layout.turn)
    return Cloud(
        origin=np.array(layout.origin, np.int64),
        position=unpacked.position,
        shift=layout.shift,
        low=unpacked.low,
        codes=from_channels(unpacked.rows, schema),
    )


def _payload(frame: bytes, limit: int) -> bytes:
    """Inflate one zstd frame of at most `limit` bytes of content."""
    try:
        if frame[:4] != ZSTD_MAGIC:
            raise Corrupt("cloud: it does not start as a zstd frame does")
        declared = zstandard.get_frame_parameters(frame)
        size = declared.content_size
        if size > limit:  # an unknown size is the largest number there is
            raise Corrupt(f"cloud: the frame declares {size} bytes, at most {limit} can be true")
        if declared.dict_id or not declared.has_checksum or declared.window_size > MAX_FRAME_WINDOW:
            raise Corrupt("cloud: the frame wants a dictionary or a huge window, or has no checksum")
        return _contexts.decompressor.decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise Corrupt(f"cloud: {error}") from error


def cloud_to_points(cloud: Cloud, header: Header) -> PointBatch:
    """Give the samples of a decoded cloud in model units.

    Parameters
    ----------
    cloud : Cloud
    header : Header
        Its `origin`, `step`, `attributes` and `constants` are used.

    Returns
    -------
    PointBatch
        Every attribute of the header, constants included.
    """
    xyz = dequantise(cloud.lattice(), np.asarray(header.origin, np.float64), header.step)
    values: dict[str, NDArray[Any]] = {}
    for attribute in header.attributes:
        codes = cloud.codes[attribute.name]
        if attribute.kind == "normal":
            values[attribute.name] = decode_normals(codes, attribute.bits)
        else:
            values[attribute.name] = attribute.decode(codes)
    for name, constant in header.constants.items():
        values[name] = constant.fill(len(cloud))
    return PointBatch(xyz, values)
