"""One cloud to bytes and back: the zstd frame around the payload (docs/format.md, Cloud).

Encoding is a pure function of the set of samples. Decoding trusts nothing: what a frame declares is bounded
before anything is allocated, and only `Corrupt` comes out of a bad one.
"""

from __future__ import annotations

import itertools
import threading
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import zstandard

from .channels import Channels, channels_of, from_channels, to_channels
from .cloud import Cloud
from .context import Near, Part, Place, line_of, select, takes_context
from .errors import Corrupt
from .lattice import dequantise
from .octahedral import decode_normals
from .payload import (
    CONTEXT,
    MAX_SAMPLES,
    MAX_SHIFT,
    ORIGIN_LIMIT,
    TOP_BITS,
    Layout,
    Packed,
    Placed,
    Unpacked,
    largest_payload,
    pack_header,
    parse_layout,
)
from .points import PointBatch

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from .attributes import Schema
    from .header import Header

Effort = Literal["default", "best", "fast"]
Engine = Literal["auto", "numpy", "compiled"]


WINDOWS: dict[Effort, int] = {"default": 64, "best": 64, "fast": 16}
"""Previous samples that predict what no context tells."""

SMALL = 1024
"""Samples of a cloud whose blocks zstd takes for small."""
ZSTD_MAGIC = bytes.fromhex("28b52ffd")
MAX_FRAME_WINDOW = 1 << 27
"""What zstd itself takes as the most that a frame may ask of a reader."""


class _Codec(Protocol):
    """What `codec_numpy` and `codec_compiled` both are."""

    def arrange(
        self, lattice: NDArray[np.int64], rows: NDArray[np.uint32], begin: int, end: int, *, flipping: bool = True
    ) -> Placed: ...

    def pack(
        self,
        placed: Placed,
        lattice: NDArray[np.int64],
        rows: NDArray[np.uint32],
        channels: Channels,
        window: int,
        near: Near | None,
    ) -> Packed: ...

    def decode(self, payload: bytes, layout: Layout, channels: Channels) -> Unpacked: ...

    def add_guesses(
        self, position: NDArray[np.uint16], rows: NDArray[np.uint32], near: Near, channels: Channels, nbits: int
    ) -> None: ...

    def box(self, position: NDArray[np.uint16]) -> tuple[Place, Place]: ...

    def take(self, parts: Sequence[Part], schema: Schema) -> Near: ...

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
    context: Sequence[Cloud] = (),
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
    context : sequence of Cloud
        The node's ancestors as they are decoded, from the root down; the last `ANCESTORS` of them count.
    effort : {"default", "best", "fast"}
        "best" lets zstd search longer; "fast" takes no context, looks at fewer previous samples, tries fewer
            orders and lets zstd search less (docs/format.md, Choices of a writer).

    Returns
    -------
    bytes
        A zstd frame. The order of the samples makes no difference to it.

    Raises
    ------
    ValueError
        If arguments are out of these ranges.
    """
    writer = CloudWriter(lattice, codes, np.array([0, len(lattice)]), schema, effort=effort, engine=engine)
    return writer.frame(writer.place(0), context)


def encode_clouds(
    lattice: NDArray[np.int64],
    codes: Mapping[str, NDArray[Any]],
    bounds: NDArray[np.int64],
    schema: Schema,
    *,
    parent: NDArray[np.int64] | None = None,
    effort: Effort = "default",
    engine: Engine = "auto",
) -> list[bytes]:
    """Pack many clouds that stand one after another: cloud `i` is samples ``bounds[i]`` to ``bounds[i + 1]``.

    The same frames as one call of `encode_cloud` each, for less: what numpy does is done once.

    Parameters
    ----------
    parent : ndarray, (n,) int64, optional
        Number of each cloud's parent among these, always a smaller one; -1 for none.
    """
    writer = CloudWriter(lattice, codes, bounds, schema, effort=effort, engine=engine)
    above = [-1] * (len(bounds) - 1) if parent is None else parent.tolist()
    inner = set(above)
    clouds: dict[int, Cloud] = {}
    frames = []
    for number in range(len(above)):
        placed = writer.place(number)
        frames.append(writer.frame(placed, [clouds[up] for up in line_of(number, above)]))
        if number in inner:
            clouds[number] = writer.cloud(placed)
    return frames


class CloudWriter:
    """Encodes clouds that stand one after another, in any order; for one thread.

    Parameters
    ----------
    lattice, codes, bounds, schema, effort, engine
        As of `encode_clouds`.
    """

    def __init__(
        self,
        lattice: NDArray[np.int64],
        codes: Mapping[str, NDArray[Any]],
        bounds: NDArray[np.int64],
        schema: Schema,
        *,
        effort: Effort = "default",
        engine: Engine = "auto",
    ) -> None:
        lattice = np.ascontiguousarray(lattice, np.int64)
        self._bounds = np.asarray(bounds).tolist()
        for begin, end in itertools.pairwise(self._bounds):
            if not 1 <= end - begin <= MAX_SAMPLES or not 0 <= begin < end <= len(lattice):
                raise ValueError(
                    f"a cloud of samples {begin} to {end} of {len(lattice)}: 1 to {MAX_SAMPLES} are allowed"
                )
        if len(lattice) and (lattice.min() <= -ORIGIN_LIMIT or lattice.max() >= ORIGIN_LIMIT):
            raise ValueError("lattice coordinates must stay below 2**52")
        self._codes, self._schema = codes, schema
        self._lattice, self._rows = lattice, to_channels(codes, schema, len(lattice))
        self._channels, self._codec = channels_of(schema), _codec(engine)
        self._window, self._compressor = WINDOWS[effort], _contexts.compressor(effort)
        self._guessing, self._flipping = takes_context(schema, effort), effort != "fast"
        # Faster strategies reuse another stream's Huffman codes in blocks up to 1 KiB, which takes up to 20 % more.
        self._small = _contexts.compressor("default" if effort == "fast" else effort)

    def place(self, number: int) -> Placed:
        """Put the samples of a cloud in order."""
        begin, end = self._bounds[number : number + 2]
        placed = self._codec.arrange(self._lattice, self._rows, begin, end, flipping=self._flipping)
        if placed.nbits > TOP_BITS or placed.shift > MAX_SHIFT:
            raise ValueError(f"a cloud spans 2**{placed.nbits + placed.shift} steps, 2**48 are the most")
        return placed

    def cloud(self, placed: Placed) -> Cloud:
        """Give a cloud as context of others, as it will be decoded: with normals and colours only."""
        low = None
        if placed.shift:
            low = ((self._lattice[placed.order] - placed.corner) & ((1 << placed.shift) - 1)).astype(np.uint32)
        codes = {item.name: self._codes[item.name][placed.order] for item in self._schema if item.kind != "scalar"}
        return Cloud(origin=placed.corner, position=placed.position, shift=placed.shift, low=low, codes=codes)

    def frame(self, placed: Placed, context: Sequence[Cloud]) -> bytes:
        """Encode a cloud; `context` as of `encode_cloud`."""
        near = None
        if context and self._guessing:
            x, y, z = placed.corner.tolist()
            near = select(
                context,
                self._schema,
                corner=(x, y, z),
                shift=placed.shift,
                position=placed.position,
                engine=self._codec,
            )
            near = near if near.rows.shape[1] else None
        packed = self._codec.pack(placed, self._lattice, self._rows, self._channels, self._window, near)
        small = len(placed.position) <= SMALL
        return _frame(packed, self._channels, self._small if small else self._compressor)


def _frame(packed: Packed, channels: Channels, compressor: zstandard.ZstdCompressor) -> bytes:
    """Compress a payload with a block for each kind of number, so that each has Huffman codes of its own."""
    head = pack_header(packed) + packed.raw.tobytes()
    stream = compressor.compressobj(size=len(head) + packed.tokens.size)
    parts = [stream.compress(head) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    for first, stop in ((-1, 0), *channels.groups):
        end = zstandard.COMPRESSOBJ_FLUSH_FINISH if stop == len(channels) else zstandard.COMPRESSOBJ_FLUSH_BLOCK
        parts.append(stream.compress(packed.tokens[1 + first : 1 + stop].data) + stream.flush(end))
    return b"".join(parts)


def decode_cloud(
    frame: bytes, *, samples: int, schema: Schema, context: Sequence[Cloud] | None = (), engine: Engine = "auto"
) -> Cloud:
    """Unpack a cloud.

    Parameters
    ----------
    frame : bytes
        As `encode_cloud` gave it, or anything.
    samples : int
        How many samples the node's record promises.
    schema : Schema
        The header's attributes.
    context : sequence of Cloud, optional
        The node's ancestors, decoded, from the root down: the last `ANCESTORS` of them, or all there are. None: the
        model is one of which no cloud is guessed from any (`is_told`).
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
    if layout.turn == CONTEXT:
        if context is None:
            raise Corrupt("cloud: it is guessed from others, and the header says that none is")
        near = select(
            context,
            schema,
            corner=layout.origin,
            shift=layout.shift,
            position=unpacked.position,
            engine=codec,
        )
        codec.add_guesses(unpacked.position, unpacked.rows, near, channels, layout.nbits)
    for first, centre in channels.normals.tolist():
        if unpacked.rows[first : first + 2].max() > 2 * centre:
            raise Corrupt("cloud: a code is no normal's")
    if 0 < layout.turn < CONTEXT:
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
    return samples_to_points(cloud.lattice(), cloud.codes, header)


def samples_to_points(lattice: NDArray[np.int64], codes: Mapping[str, NDArray[Any]], header: Header) -> PointBatch:
    """Give samples, of one or many clouds, in model units; see `cloud_to_points`."""
    xyz = dequantise(lattice, np.asarray(header.origin, np.float64), header.step)
    values: dict[str, NDArray[Any]] = {}
    for attribute in header.attributes:
        if attribute.kind == "normal":
            values[attribute.name] = decode_normals(codes[attribute.name], attribute.bits)
        else:
            values[attribute.name] = attribute.decode(codes[attribute.name])
    for name, constant in header.constants.items():
        values[name] = constant.fill(len(lattice))
    return PointBatch(xyz, values)
