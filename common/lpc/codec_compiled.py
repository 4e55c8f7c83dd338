"""The payload of a cloud in compiled kernels; `codec_numpy` is the oracle.

All kernels and their helpers stand in this module: the compiler's cache does not see changes in other files.
They release the interpreter lock. No kernel checks an index: `payload.parse_layout` has proved them all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .guess_compiled import add_guesses as add_guesses
from .guess_compiled import box as box
from .guess_compiled import take as take
from .guess_compiled import without_guesses
from .normals_compiled import best_turn
from .normals_compiled import turn_back as turn_back
from .payload import CONTEXT, Layout, Packed, Placed, Unpacked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels
    from .context import Near

PAD = 64
"""Far samples in front of the first, so that every sample has a full window."""
FAR = np.float32(-200_000)
"""Further than any L1 distance of 16-bit coordinates (196,605)."""
DIGIT = 11
"""Bits sorted per pass at most: a few passes for a cloud's code, and counts that stay in the first cache."""

STRETCH = 512
"""Samples that look back together: what they need stays in the first cache."""

# "Nearest" computes with float32 because the compiler widens int32 sums to int64 and then finds no fast
# minimum. All values are integers below 2**24, so nothing is rounded; "no NaN" lets it vectorise.
_EXACT_FLOATS = {"nnan", "nsz"}


def arrange(
    lattice: NDArray[np.int64], rows: NDArray[np.uint32], begin: int, end: int, *, flipping: bool = True
) -> Placed:
    """Put the samples begin to end in the order of the file; `flipping`: flips of axes are tried."""
    rotation, flips, nbits, shift, corner, code, order = _arrange(lattice, rows, begin, end, flipping)
    position = np.empty((end - begin, 3), np.uint16)
    _gather_position(lattice, corner, shift, order, position)
    return Placed(rotation, flips, nbits, shift, corner, order, code, position)


def pack(
    placed: Placed,
    lattice: NDArray[np.int64],
    rows: NDArray[np.uint32],
    channels: Channels,
    window: int,
    near: Near | None,
) -> Packed:
    """Pack a cloud; normals and colours are guessed from what is near if that is given."""
    k = len(placed.order)
    sorted_rows = rows.take(placed.order, axis=1)
    guessed = np.zeros(len(channels), np.bool_)
    turn = 0
    if near:
        guessed[channels.guessed_rows] = True
        turn = CONTEXT
    before = np.zeros(k, np.int64)
    window = 0 if guessed.all() else window
    if window:
        _predecessors(placed.position, window, before)
    if near:
        sorted_rows[guessed] = without_guesses(placed.position, sorted_rows, near, channels, placed.nbits)
    elif len(channels.normals):
        turn, sorted_rows = best_turn(sorted_rows, before, channels)
    raw, tokens = _pack(
        lattice, placed.corner, placed.shift, 3 * placed.nbits, placed.order, placed.code, sorted_rows, before,
        channels.bits, channels.start, guessed,
    )  # fmt: skip
    return Packed(placed, turn, window, raw, tokens)


def decode(payload: bytes, layout: Layout, channels: Channels) -> Unpacked:
    """Unpack a payload that `parse_layout` found true; guessed channels get their residuals, signed."""
    k = layout.samples
    data = np.frombuffer(payload + bytes(8), np.uint8)
    position = np.empty((k, 3), np.uint16)
    low = np.empty((k if layout.shift else 0, 3), np.uint32)
    rows = np.empty((len(channels), k), np.uint32)
    before = np.zeros(k, np.int64)
    added = np.ones(len(channels), np.bool_)
    if layout.turn == CONTEXT:
        added[channels.guessed_rows] = False
    largest = _decode(
        data, layout.starts, layout.tokens, layout.rotation, layout.flips, layout.nbits, layout.shift, layout.window,
        channels.bits, channels.start, added, position, low, before, rows,
    )  # fmt: skip
    return Unpacked(int(largest), position, low if layout.shift else None, rows)


@njit(cache=True, nogil=True)
def _bit_length(number: Any) -> Any:
    """Bits of an unsigned number below 2**64."""
    length = np.int64(0)
    for step in (32, 16, 8, 4, 2, 1):
        if number >> np.uint64(step):
            number >>= np.uint64(step)
            length += step
    return length + np.int64(number)


@njit(cache=True, nogil=True)
def _spread(value: Any) -> Any:
    """16 bits to every third of 48."""
    value = (value | (value << np.uint64(16))) & np.uint64(0x0000FF0000FF)
    value = (value | (value << np.uint64(8))) & np.uint64(0x00F00F00F00F)
    value = (value | (value << np.uint64(4))) & np.uint64(0x0C30C30C30C3)
    return (value | (value << np.uint64(2))) & np.uint64(0x249249249249)


@njit(cache=True, nogil=True)
def _gather(value: Any) -> Any:
    """Every third of 48 bits to 16."""
    value &= np.uint64(0x249249249249)
    value = (value | (value >> np.uint64(2))) & np.uint64(0x0C30C30C30C3)
    value = (value | (value >> np.uint64(4))) & np.uint64(0x00F00F00F00F)
    value = (value | (value >> np.uint64(8))) & np.uint64(0x0000FF0000FF)
    return (value | (value >> np.uint64(16))) & np.uint64(0xFFFF)


@njit(cache=True, nogil=True)
def _exponents(number: Any, floats: Any) -> Any:
    """Where the first bit of each number below 2**53 is, in a view of `floats`: 1023 more; 0 for 0."""
    for i in range(len(number)):
        floats[i] = np.float64(np.int64(number[i]))
    exponent = floats.view(np.int64)
    for i in range(len(number)):
        exponent[i] >>= 52
    return exponent


@njit(cache=True, nogil=True)
def _starts(code: Any, place: Any, count: Any, digits: int) -> None:
    """Where the codes of each digit begin when they are sorted by it."""
    mask = np.uint64(digits - 1)
    count[:digits] = 0
    for i in range(len(code)):
        count[(code[i] >> place) & mask] += 1
    total = np.uint32(0)
    for digit in range(digits):
        here = count[digit]
        count[digit] = total
        total += here


@njit(cache=True, nogil=True)
def _sort_codes(code: Any, spare: Any, bits: int, count: Any) -> bool:
    """Radix sort of codes; True if the result lies in the spare array."""
    swapped = False
    width = -(-bits // -(-bits // DIGIT)) if bits else 1
    mask = np.uint64((1 << width) - 1)
    for at in range(0, bits, width):
        place = np.uint64(at)
        _starts(code, place, count, 1 << width)
        for i in range(len(code)):
            value = code[i]
            digit = (value >> place) & mask
            spare[count[digit]] = value
            count[digit] += np.uint32(1)
        code, spare = spare, code
        swapped = not swapped
    return swapped


@njit(cache=True, nogil=True)
def _sort_order(code: Any, spare: Any, order: Any, order_spare: Any, bits: int, count: Any) -> bool:
    """Do so with the samples' numbers."""
    swapped = False
    width = -(-bits // -(-bits // DIGIT)) if bits else 1
    mask = np.uint64((1 << width) - 1)
    for at in range(0, bits, width):
        place = np.uint64(at)
        _starts(code, place, count, 1 << width)
        for i in range(len(code)):
            value = code[i]
            digit = (value >> place) & mask
            to = count[digit]
            count[digit] = to + np.uint32(1)
            spare[to] = value
            order_spare[to] = order[i]
        code, spare = spare, code
        order, order_spare = order_spare, order
        swapped = not swapped
    return swapped


@njit(cache=True, nogil=True)
def _less(lattice: Any, rows: Any, a: int, b: int) -> bool:
    """Order of samples of one Morton code: full coordinates, then channels."""
    for axis in range(3):
        if lattice[a, axis] != lattice[b, axis]:
            return lattice[a, axis] < lattice[b, axis]
    for row in range(rows.shape[0]):
        if rows[row, a] != rows[row, b]:
            return rows[row, a] < rows[row, b]
    return False


@njit(cache=True, nogil=True)
def _sort_ties(lattice: Any, rows: Any, order: Any, first: int, stop: int) -> None:
    """Shell sort of one run of equal codes: short as a rule, a million coincident samples at worst."""
    gap = 1
    while gap < (stop - first) // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(first + gap, stop):
            moving = order[i]
            to = i
            while to - gap >= first and _less(lattice, rows, moving, order[to - gap]):
                order[to] = order[to - gap]
                to -= gap
            order[to] = moving
        gap //= 3


@njit(cache=True, nogil=True)
def _put(raw: Any, at: Any, pending: Any, filled: Any, value: Any, width: Any) -> Any:
    """Append `width` bits, at most 56; returns byte, pending bits and their number (below 8). All are unsigned."""
    pending |= value << filled
    filled += width
    # All 8 bytes are written, and what is not full is written over: no branch to guess, and one store.
    for byte in range(8):
        raw[at + np.uint64(byte)] = np.uint8((pending >> np.uint64(8 * byte)) & np.uint64(255))
    whole = filled >> np.uint64(3)
    return at + whole, (pending >> (np.uint64(4) * whole)) >> (np.uint64(4) * whole), filled & np.uint64(7)


@njit(cache=True, nogil=True)
def _finish(raw: Any, at: Any, pending: Any, filled: Any) -> Any:
    """Pad a bit stream to a byte."""
    if filled:
        raw[at] = np.uint8(pending)
        at += np.uint64(1)
    return at


@njit(cache=True, nogil=True)
def _write(number: Any, floats: Any, tokens: Any, raw: Any, at: Any) -> Any:
    """Write a channel of numbers as tokens and one raw stream from byte `at` on; returns its end."""
    exponent = _exponents(number, floats)
    pending, filled = np.uint64(0), np.uint64(0)
    for i in range(len(number)):
        value, width = number[i], np.uint64(max(exponent[i] - 1024, 0))
        # 0 and 1 are their own tokens; then the width and the two first bits, which are 2 or 3, make the token.
        top = value >> width
        tokens[i] = np.uint8(np.uint64(2) * width + top)
        at, pending, filled = _put(raw, at, pending, filled, value ^ (top << width), width)
    return _finish(raw, at, pending, filled)


@njit(cache=True, nogil=True, fastmath=_EXACT_FLOATS)
def _nearest(xs: Any, ys: Any, zs: Any, begin: int, window: int, best: Any) -> None:
    """Fill in how near the nearest of the `window` samples before each is (L1), times 64, and how far back less 1."""
    x, y, z = xs[begin : begin + len(best)], ys[begin : begin + len(best)], zs[begin : begin + len(best)]
    best[:] = np.float32(3e38)
    # All samples at once look one place back, then two: one after another they would make no vectors.
    for back in range(1, window + 1):
        at = begin - back
        a, b, c = xs[at : at + len(best)], ys[at : at + len(best)], zs[at : at + len(best)]
        for i in range(len(best)):
            distance = abs(a[i] - x[i]) + abs(b[i] - y[i]) + abs(c[i] - z[i])
            best[i] = min(best[i], distance * np.float32(64) + np.float32(back - 1))


@njit(cache=True, nogil=True)
def _predecessors(position: Any, window: int, before: Any) -> None:
    """Fill in how far back the nearest of the `window` samples before each stands; 0: there is none."""
    k = len(before)
    xs, ys, zs = np.empty(PAD + k, np.float32), np.empty(PAD + k, np.float32), np.empty(PAD + k, np.float32)
    xs[:PAD] = FAR
    ys[:PAD] = 0
    zs[:PAD] = 0
    for i in range(k):
        xs[PAD + i], ys[PAD + i], zs[PAD + i] = position[i, 0], position[i, 1], position[i, 2]
    best = np.empty(min(k, STRETCH), np.float32)
    for begin in range(0, k, STRETCH):
        count = min(STRETCH, k - begin)
        _nearest(xs, ys, zs, PAD + begin, window, best[:count])
        for i in range(count):
            before[begin + i] = (np.int64(best[i]) & 63) + 1 if window else 0
    before[0] = 0


@njit(cache=True, nogil=True)
def _residuals(value: Any, before: Any, bits: int, start: int, number: Any) -> None:
    """Zigzag of the residuals of one channel."""
    mask = np.uint32((np.int64(1) << bits) - 1)
    half = np.int64(1) << (bits - 1)
    for i in range(len(value)):
        back = before[i]
        guess = value[i - back] if back else np.uint32(start)
        residual = np.int64(np.uint32(value[i] - guess) & mask)
        number[i] = np.uint64(2 * residual if residual < half else 2 * (2 * half - residual) - 1)


@njit(cache=True, nogil=True)
def _arrange(lattice: Any, rows: Any, begin: int, end: int, flipping: bool) -> Any:
    """Sort samples; returns rotation, flips, bits and low bits of coordinates, corner, codes and sample numbers."""
    k = end - begin
    corner = lattice[begin].copy()
    far = lattice[begin].copy()
    for i in range(begin, end):
        for axis in range(3):
            corner[axis] = min(corner[axis], lattice[i, axis])
            far[axis] = max(far[axis], lattice[i, axis])
    width = _bit_length(np.uint64(max(far[0] - corner[0], far[1] - corner[1], far[2] - corner[2])))
    shift = max(0, width - 16)
    nbits = width - shift

    # Flips move the corner, by less than 2**16: same limit as `payload.may_flip`.
    flipping &= shift == 0 and min(corner[0], corner[1], corner[2]) > (1 << 16) - (np.int64(1) << 52)
    span = np.empty(3, np.int64)
    spread = np.empty((2, 3, k), np.uint64)
    for axis in range(3):
        span[axis] = (far[axis] - corner[axis]) >> shift
        for i in range(k):
            local = (lattice[begin + i, axis] - corner[axis]) >> shift
            spread[0, axis, i] = _spread(np.uint64(local))
            if flipping:
                spread[1, axis, i] = _spread(np.uint64(span[axis] - local))

    # The rotation that makes the differences shortest puts the thin axis in the top bit of every three; the best flips
    # let the curve follow slopes.
    code, spare = np.empty(k, np.uint64), np.empty(k, np.uint64)
    order, order_spare = np.empty(k, np.uint32), np.empty(k, np.uint32)
    count, floats = np.empty(1 << DIGIT, np.uint32), np.empty(k, np.float64)
    rotation = flips = 0
    least = np.int64(0)
    tries = 10 if flipping else 3
    for attempt in range(tries + 1):  # the last is for the best once more, now with the numbers of the samples
        turn = attempt if attempt < 3 else rotation
        flipped = flips if attempt == tries else max(attempt - 2, 0)
        a, b, c = turn, (turn + 1) % 3, (turn + 2) % 3
        in_a, in_b, in_c = spread[flipped >> a & 1, a], spread[flipped >> b & 1, b], spread[flipped >> c & 1, c]
        for i in range(k):
            code[i] = in_a[i] | (in_b[i] << np.uint64(1)) | (in_c[i] << np.uint64(2))
        if attempt == tries:
            break
        if _sort_codes(code, spare, 3 * nbits, count):
            code, spare = spare, code
        spare[0] = code[0]
        for i in range(1, k):
            spare[i] = code[i] - code[i - 1]
        exponent = _exponents(spare, floats)
        cost = np.int64(0)
        for i in range(k):
            cost += max(exponent[i] - 1022, 0)
        if attempt == 0 or cost < least:
            least = cost
            rotation, flips = turn, flipped
    for i in range(k):
        order[i] = begin + i
    if _sort_order(code, spare, order, order_spare, 3 * nbits, count):
        code, order = spare, order_spare

    first = 0
    for i in range(1, k + 1):
        if i == k or code[i] != code[first]:
            if i - first > 1:
                _sort_ties(lattice, rows, order, first, i)
            first = i
    for axis in range(3):  # the last sample of a flipped axis stands at the end of its range
        if flips >> axis & 1:
            corner[axis] -= (1 << nbits) - 1 - span[axis]
    return rotation, flips, nbits, shift, corner, code, order


@njit(cache=True, nogil=True)
def _gather_position(lattice: Any, corner: Any, shift: int, order: Any, position: Any) -> None:
    """Local coordinates without low bits, in order."""
    for i in range(len(order)):
        for axis in range(3):
            position[i, axis] = (lattice[order[i], axis] - corner[axis]) >> shift


@njit(cache=True, nogil=True)
def _pack(
    lattice: Any, corner: Any, shift: int, code_bits: int, order: Any, code: Any, rows: Any, before: Any, bits: Any,
    start: Any, ready: Any,
) -> Any:  # fmt: skip
    """Write all streams; rows that are `ready` are numbers already."""
    k = len(order)
    raw_bits = 3 * shift + max(code_bits - 2, 0)
    for row in range(len(bits)):
        raw_bits += max(bits[row] - 2, 0)
    raw = np.empty((k * raw_bits + 7) // 8 + 10 + len(bits), np.uint8)
    tokens = np.empty((1 + len(bits), k), np.uint8)
    at = np.uint64(0)
    if shift:
        pending, filled = np.uint64(0), np.uint64(0)
        mask = (np.int64(1) << shift) - 1
        for i in range(k):
            for axis in range(3):
                low = np.uint64((lattice[order[i], axis] - corner[axis]) & mask)
                at, pending, filled = _put(raw, at, pending, filled, low, np.uint64(shift))
        at = _finish(raw, at, pending, filled)

    number, floats = np.empty(k, np.uint64), np.empty(k, np.float64)
    number[0] = code[0]
    for i in range(1, k):
        number[i] = code[i] - code[i - 1]
    at = _write(number, floats, tokens[0], raw, at)
    for row in range(len(bits)):
        if ready[row]:
            for i in range(k):
                number[i] = rows[row, i]
        else:
            _residuals(rows[row], before, bits[row], start[row], number)
        at = _write(number, floats, tokens[1 + row], raw, at)
    return raw[: np.int64(at)], tokens


@njit(cache=True, nogil=True)
def _word(data: Any, bit: Any) -> Any:
    """At least 57 bits from bit `bit` on."""
    at = bit >> np.uint64(3)
    word = np.uint64(0)
    for byte in range(8):
        word |= np.uint64(data[at + np.uint64(byte)]) << np.uint64(8 * byte)
    return word >> (bit & np.uint64(7))


@njit(cache=True, nogil=True)
def _number(data: Any, bit: Any, token: Any) -> Any:
    """One number from its token and the raw stream; returns the bit after it, too."""
    if token < 2:
        return np.uint64(token), bit
    width = np.uint64((token >> 1) - 1)
    raw = _word(data, bit) & ((np.uint64(1) << width) - np.uint64(1))
    return (np.uint64(2 | (token & 1)) << width) | raw, bit + width


@njit(cache=True, nogil=True)
def _decode(
    data: Any, starts: Any, tokens: int, rotation: int, flips: int, nbits: int, shift: int, window: int,
    bits: Any, start: Any, added: Any, position: Any, low: Any, before: Any, rows: Any,
) -> Any:  # fmt: skip
    """Fill in the arrays; rows that are not `added` up get their residuals, signed. Returns the largest code."""
    k = len(position)
    if shift:
        bit = np.uint64(starts[0] * 8)
        mask = (np.uint64(1) << np.uint64(shift)) - np.uint64(1)
        for i in range(k):
            for axis in range(3):
                low[i, axis] = _word(data, bit) & mask
                bit += np.uint64(shift)

    a, b, c = rotation, (rotation + 1) % 3, (rotation + 2) % 3
    code = np.uint64(0)
    largest = np.uint64(0)
    reach = (1 << nbits) - 1
    at_a, at_b, at_c = np.uint64(0), np.uint64(0), np.uint64(0)
    if flips >> a & 1:
        at_a = np.uint64(reach)
    if flips >> b & 1:
        at_b = np.uint64(reach)
    if flips >> c & 1:
        at_c = np.uint64(reach)
    bit = np.uint64(starts[1] * 8)
    for i in range(k):
        step, bit = _number(data, bit, data[tokens + i])
        code += step
        largest = max(largest, code)
        x, y, z = _gather(code), _gather(code >> np.uint64(1)), _gather(code >> np.uint64(2))
        position[i, a], position[i, b], position[i, c] = x ^ at_a, y ^ at_b, z ^ at_c

    if len(bits):
        if window:
            _predecessors(position, window, before)
        for row in range(len(bits)):
            tokens += k
            bit = np.uint64(starts[2 + row] * 8)
            levels = np.uint32((np.int64(1) << bits[row]) - 1)
            value = rows[row]
            for i in range(k):
                zigzag, bit = _number(data, bit, data[tokens + i])
                residual = np.uint32((zigzag >> np.uint64(1)) ^ (np.uint64(0) - (zigzag & np.uint64(1))))
                if added[row]:
                    back = before[i]
                    guess = value[i - back] if back else np.uint32(start[row])
                    value[i] = np.uint32(np.uint32(guess + residual) & levels)
                else:
                    value[i] = residual
    return largest
