"""What a light JPEG leaves of a picture: blocks of 8 x 8 pixels, coarser in detail. Compiled.

All that a file loses is lost before its bits are counted, so nothing is written and read: colours
are turned, blocks transformed, coefficients rounded to steps, and all of it undone, in the integers
of libjpeg's accurate transform. So the pixels are those of its files, bit by bit.

Source:
    ITU-T T.81 and T.871 (JFIF); the transform of Loeffler, Ligtenberg and Moschytz, "Practical fast
    1-D DCT algorithms with 11 multiplications", ICASSP 1989.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

BLOCK_PX = 8
_LANES = 16
"""Blocks side by side that are worked on together: as many as a vector of the widest machine."""
_COLUMN = BLOCK_PX * _LANES

# Steps of quality 50 for brightness and for colour, ITU-T T.81, tables K.1 and K.2.
_BRIGHTNESS = (
    *(16, 11, 10, 16, 24, 40, 51, 61),
    *(12, 12, 14, 19, 26, 58, 60, 55),
    *(14, 13, 16, 24, 40, 57, 69, 56),
    *(14, 17, 22, 29, 51, 87, 80, 62),
    *(18, 22, 37, 56, 68, 109, 103, 77),
    *(24, 35, 55, 64, 81, 104, 113, 92),
    *(49, 64, 78, 87, 103, 121, 120, 101),
    *(72, 92, 95, 98, 112, 100, 103, 99),
)
_COLOUR = (
    *(17, 18, 24, 47, 99, 99, 99, 99),
    *(18, 21, 26, 66, 99, 99, 99, 99),
    *(24, 26, 56, 99, 99, 99, 99, 99),
    *(47, 66, 99, 99, 99, 99, 99, 99),
    *(99,) * 32,
)

# The transform's constants, with 13 bits after the point: sums of cosines of multiples of pi / 16.
_BITS, _SPARE_BITS = 13, 2
_C = [np.sqrt(2.0) * np.cos(k * np.pi / 16.0) for k in range(8)]


def _fixed(value: float) -> np.int32:
    return np.int32(round(value * 2**_BITS))


_EVEN = (_fixed(_C[6]), _fixed(_C[2] - _C[6]), _fixed(-_C[2] - _C[6]))
_ODD_ONE = (
    *(_fixed(-_C[1] + _C[3] + _C[5] - _C[7]), _fixed(_C[1] + _C[3] - _C[5] + _C[7])),
    *(_fixed(_C[1] + _C[3] + _C[5] - _C[7]), _fixed(_C[1] + _C[3] - _C[5] - _C[7])),
)
_ODD_TWO = (
    *(_fixed(_C[7] - _C[3]), _fixed(-_C[1] - _C[3])),
    *(_fixed(-_C[3] - _C[5]), _fixed(_C[5] - _C[3])),
)
_ODD_ALL = _fixed(_C[3])


def steps_of(quality: int) -> Float32:
    """(3, 8, 8) whole steps of brightness and of the two colours, as libjpeg scales its tables.

    The first index of a coefficient counts waves along a row.

    Args:
        quality: In [1, 100].
    """
    percent = 5000 // quality if quality < 50 else 200 - 2 * quality
    table = np.array((_BRIGHTNESS, _COLOUR, _COLOUR), np.int64)
    steps = np.clip((table * percent + 50) // 100, 1, 255).astype(np.float32)
    return np.ascontiguousarray(steps.reshape(3, BLOCK_PX, BLOCK_PX).transpose(0, 2, 1))


@compiled
def compress(words: Any, steps: Any) -> None:
    """Compress a strip of blocks in place, with all colours at full resolution.

    A row of a block is one word of eight pixels, so that blocks side by side become the lanes of a
    vector by shifts alone.

    Args:
        words: (3, 8, W / 8) uint64: red, green and blue levels, the first pixel in the lowest byte.
        steps: (3, 8, 8) float32, see `steps_of`.
    """
    wide = words.shape[2]
    # Place (x, y) of block b is at x * _COLUMN + y * _LANES + b.
    blocks = np.empty((3, BLOCK_PX * _COLUMN), np.int32)
    some = np.zeros((BLOCK_PX, _LANES), np.uint64)
    lanes = np.empty((3, BLOCK_PX * _COLUMN), np.float32)
    shares = np.empty_like(lanes)
    for channel in range(3):
        lanes[channel] = np.repeat(steps[channel].reshape(-1), _LANES)
        shares[channel] = np.float32(0.125) / lanes[channel]
    for left in range(0, wide, _LANES):
        count = min(_LANES, wide - left)
        for channel in range(3):
            for y in range(BLOCK_PX):
                for b in range(count):
                    some[y, b] = words[channel, y, left + b]
            _unpack(some.reshape(-1), blocks[channel])
        _turn(blocks[0], blocks[1], blocks[2])
        for channel in range(3):
            _coarsen(blocks[channel], lanes[channel], shares[channel])
        _turn_back(blocks[0], blocks[1], blocks[2])
        for channel in range(3):
            _pack(blocks[channel], some.reshape(-1))
            for y in range(BLOCK_PX):
                for b in range(count):
                    words[channel, y, left + b] = some[y, b]


@compiled
def _unpack(words: Any, block: Any) -> None:
    for x in range(BLOCK_PX):
        at, shift = x * _COLUMN, np.uint64(8 * x)
        for i in range(_COLUMN):
            block[at + i] = np.int32((words[i] >> shift) & np.uint64(255))


@compiled
def _pack(block: Any, words: Any) -> None:
    for i in range(_COLUMN):
        word = np.uint64(0)
        for x in range(BLOCK_PX):
            word |= np.uint64(np.uint32(block[x * _COLUMN + i])) << np.uint64(8 * x)
        words[i] = word


@compiled
def _turn(first: Any, second: Any, third: Any) -> None:
    """Red, green and blue to brightness and two colours around 0.

    16 bits after the point; halves of brightness go up, those of colours down.
    """
    for i in range(BLOCK_PX * _COLUMN):
        r, g, b = first[i], second[i], third[i]
        light = np.int32(19595 * r + 38470 * g + 7471 * b + 32768)
        cb = np.int32(-11059 * r - 21709 * g + 32768 * b + 32767)
        cr = np.int32(32768 * r - 27439 * g - 5329 * b + 32767)
        first[i] = np.int32(light >> 16) - np.int32(128)
        second[i] = np.int32(cb >> 16)
        third[i] = np.int32(cr >> 16)


@compiled
def _turn_back(first: Any, second: Any, third: Any) -> None:
    """The inverse, to levels."""
    for i in range(BLOCK_PX * _COLUMN):
        light = _clipped(np.int32(first[i] + 128))
        cb = np.int32(_clipped(np.int32(second[i] + 128)) - 128)
        cr = np.int32(_clipped(np.int32(third[i] + 128)) - 128)
        red = np.int32(91881 * cr + 32768)
        green = np.int32(-22554 * cb - 46802 * cr + 32768)
        blue = np.int32(116130 * cb + 32768)
        first[i] = _clipped(np.int32(light + np.int32(red >> 16)))
        second[i] = _clipped(np.int32(light + np.int32(green >> 16)))
        third[i] = _clipped(np.int32(light + np.int32(blue >> 16)))


@inlined
def _clipped(v: Any) -> Any:
    v = v if v > np.int32(0) else np.int32(0)
    return v if v < np.int32(255) else np.int32(255)


@compiled
def _coarsen(block: Any, steps: Any, shares: Any) -> None:
    """Transform blocks, round their coefficients to the steps, and transform them back."""
    for y in range(BLOCK_PX):
        _forward(block, y * _LANES, _COLUMN, _BITS - _SPARE_BITS)
    for x in range(BLOCK_PX):
        _forward(block, x * _COLUMN, _LANES, _BITS + _SPARE_BITS)
    _round(block, steps, shares)
    for x in range(BLOCK_PX):
        _backward(block, x * _COLUMN, _LANES, _BITS - _SPARE_BITS)
    for y in range(BLOCK_PX):
        _backward(block, y * _LANES, _COLUMN, _BITS + _SPARE_BITS + 3)


@compiled
def _round(block: Any, steps: Any, shares: Any) -> None:
    """Coefficients, which are eight times as large, to whole steps, halves away from zero."""
    half, zero = np.float32(0.5), np.float32(0.0)
    for i in range(BLOCK_PX * _COLUMN):
        v = np.float32(block[i])
        # The half more keeps what divides evenly off the edge, which a reciprocal may miss.
        size = np.floor((abs(v) + half) * shares[i] + half) * steps[i]
        block[i] = np.int32(size if v > zero else -size)


@inlined
def _forward(block: Any, start: Any, stride: Any, bits: Any) -> None:
    """Eight numbers of each block, `stride` apart, to eight coefficients in their places."""
    for b in range(start, start + _LANES):
        a0, a7 = block[b], block[b + 7 * stride]
        a1, a6 = block[b + stride], block[b + 6 * stride]
        a2, a5 = block[b + 2 * stride], block[b + 5 * stride]
        a3, a4 = block[b + 3 * stride], block[b + 4 * stride]
        s0, s1 = np.int32(a0 + a7), np.int32(a1 + a6)
        s2, s3 = np.int32(a2 + a5), np.int32(a3 + a4)
        e0, e3 = np.int32(s0 + s3), np.int32(s0 - s3)
        e1, e2 = np.int32(s1 + s2), np.int32(s1 - s2)
        block[b] = _descaled(np.int32((e0 + e1) << _BITS), bits)
        block[b + 4 * stride] = _descaled(np.int32((e0 - e1) << _BITS), bits)
        both = np.int32((e2 + e3) * _EVEN[0])
        block[b + 2 * stride] = _descaled(np.int32(both + e3 * _EVEN[1]), bits)
        block[b + 6 * stride] = _descaled(np.int32(both + e2 * _EVEN[2]), bits)
        d7, d5, d3, d1 = _odd(
            np.int32(a3 - a4), np.int32(a2 - a5), np.int32(a1 - a6), np.int32(a0 - a7)
        )
        block[b + 7 * stride] = _descaled(d7, bits)
        block[b + 5 * stride] = _descaled(d5, bits)
        block[b + 3 * stride] = _descaled(d3, bits)
        block[b + stride] = _descaled(d1, bits)


@inlined
def _backward(block: Any, start: Any, stride: Any, bits: Any) -> None:
    """The inverse of `_forward`, eight times as large."""
    for b in range(start, start + _LANES):
        c0, c4 = block[b], block[b + 4 * stride]
        c2, c6 = block[b + 2 * stride], block[b + 6 * stride]
        both = np.int32((c2 + c6) * _EVEN[0])
        e2, e3 = np.int32(both + c6 * _EVEN[2]), np.int32(both + c2 * _EVEN[1])
        e0, e1 = np.int32((c0 + c4) << _BITS), np.int32((c0 - c4) << _BITS)
        a0, a3 = np.int32(e0 + e3), np.int32(e0 - e3)
        a1, a2 = np.int32(e1 + e2), np.int32(e1 - e2)
        d3, d2, d1, d0 = _odd(
            block[b + 7 * stride], block[b + 5 * stride], block[b + 3 * stride], block[b + stride]
        )
        block[b] = _descaled(np.int32(a0 + d0), bits)
        block[b + 7 * stride] = _descaled(np.int32(a0 - d0), bits)
        block[b + stride] = _descaled(np.int32(a1 + d1), bits)
        block[b + 6 * stride] = _descaled(np.int32(a1 - d1), bits)
        block[b + 2 * stride] = _descaled(np.int32(a2 + d2), bits)
        block[b + 5 * stride] = _descaled(np.int32(a2 - d2), bits)
        block[b + 3 * stride] = _descaled(np.int32(a3 + d3), bits)
        block[b + 4 * stride] = _descaled(np.int32(a3 - d3), bits)


@inlined
def _odd(p0: Any, p1: Any, p2: Any, p3: Any) -> Any:
    """The odd half, which is its own inverse but for the order: four numbers from four."""
    z0, z1 = np.int32((p0 + p3) * _ODD_TWO[0]), np.int32((p1 + p2) * _ODD_TWO[1])
    z2, z3 = np.int32(p0 + p2), np.int32(p1 + p3)
    all_ = np.int32((z2 + z3) * _ODD_ALL)
    z2, z3 = np.int32(z2 * _ODD_TWO[2] + all_), np.int32(z3 * _ODD_TWO[3] + all_)
    return (
        np.int32(p0 * _ODD_ONE[0] + z0 + z2),
        np.int32(p1 * _ODD_ONE[1] + z1 + z3),
        np.int32(p2 * _ODD_ONE[2] + z1 + z2),
        np.int32(p3 * _ODD_ONE[3] + z0 + z3),
    )


@inlined
def _descaled(v: Any, bits: Any) -> Any:
    """Divided by a power of two, halves upwards.

    `v` must be an int32: numba counts in 64 bits, and the compiler finds back to vectors of 32
    only from sums that are cut to them before they are shifted.
    """
    rounded = np.int32(v + (1 << (bits - 1)))
    return np.int32(rounded >> bits)
