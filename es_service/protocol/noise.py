"""The project's one random generator: counter-based, integer, the same bits in NumPy, XLA and compiled kernels.

A leaf of the import graph. A number is a pure function of its address, so it is made again wherever it is needed and
never sent, stored or drawn from a stateful stream. An address has two halves:

* the *stream*: (run seed, key domain, generation, ids ...), hashed here in 64-bit NumPy into a key of four words;
* the *coordinate*: a uint32 counter inside the stream (a policy parameter, a control step x action, ...), hashed with
  the key by `hash_words`, 32-bit integer operations only, which NumPy, XLA and vector units all do exactly.

The normal variate is a count of coin flips: 62 hashed bits are counted and 2 more spread the count over quarter steps,
`k = 8 * ones + 2 * dither - 251`, an odd integer with |k| <= 251. Its standard deviation is exactly sqrt(997), so
`k / sqrt(997)` has mean 0, variance 1, skewness 0, excess kurtosis -0.032, and |x| <= 7.95. The lattice step is 0.063
standard deviations. `k` is exact in int8 (as (k - 1) / 2), in bfloat16 and in float32, so any storage of it gives the
same rollout and the same gradient.

Functions that run on both sides take the array namespace as `xp` (numpy or jax.numpy).
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Keys = NDArray[np.uint32]
"""Stream keys: leading axes of the ids they were made from, then 4 words."""

NORMAL_STD = math.sqrt(997.0)
"""Standard deviation of `normal_integers`: sqrt(64 * 62 / 4 + 5)."""
KEY_WORDS = 4


class Domain(IntEnum):
    """What a stream is for. Two uses never share a stream."""

    INITIALISATION = 0
    PARAMETER_NOISE = 1
    TRAINING_RESET = 2
    EVALUATION_RESET = 3
    ACTION_NOISE = 4
    SELECTION = 5


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_HALVES = _GOLDEN * np.arange(1, 3, dtype=np.uint64)
_MASK = 2**64 - 1
_WEYL, _MUL_1, _MUL_2, _MUL_3, _MUL_4 = (
    np.uint32(word) for word in (0x9E3779B9, 0x21F0AAAD, 0xD35A2D97, 0x85EBCA6B, 0xC2B2AE35)
)
_2, _8, _15, _16 = np.uint32(2), np.uint32(8), np.uint32(15), np.uint32(16)


def _mix64(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """A bijection of 64-bit words that scatters every input bit (the finaliser of splitmix64)."""
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return x ^ (x >> np.uint64(31))


def _mix(x: int) -> int:
    """The same of one word, in Python integers; avoids the overhead of NumPy calls."""
    x = (x ^ (x >> 30)) * int(_MIX_1) & _MASK
    x = (x ^ (x >> 27)) * int(_MIX_2) & _MASK
    return x ^ (x >> 31)


def stream_keys(seed: int, domain: Domain | tuple[Domain, ...], generation: int, *ids: Any) -> Keys:
    """Keys of the streams (seed, domain, generation, *ids); ids are ints or integer arrays that broadcast together.

    Returns:
        uint32 array of the broadcast shape of `ids` + (4,), with an axis in front for several domains. Streams that
        differ only in the last field never collide.
    """
    domains = domain if isinstance(domain, tuple) else (domain,)
    # An axis of domains always: NumPy warns where a scalar wraps around, but not where an array does.
    state = np.array([_prefix(seed, one, generation) for one in domains], np.uint64)
    state = state.reshape(-1, *[1] * max(map(np.ndim, ids), default=0))
    for field in ids:
        state = _mix64((state ^ np.asarray(field, np.uint64)) + _GOLDEN)
    halves = _mix64(state[..., None] + _HALVES)
    words = halves.astype("<u8", copy=False).view("<u4")  # the lower half of each comes first
    return words if isinstance(domain, tuple) else words[0]


def _prefix(seed: int, domain: Domain, generation: int) -> int:
    state = 0
    for field in (int(seed), int(domain), int(generation)):
        if not 0 <= field <= _MASK:
            raise OverflowError(f"{field} is not a field of 64 bits")
        state = _mix((state ^ field) + int(_GOLDEN) & _MASK)
    return state


def hash_words(key: Any, coordinate: Any) -> tuple[Any, Any]:
    """Two hashed words of each coordinate of one stream.

    Args:
        key: uint32 [4].
        coordinate: uint32 array, any shape.

    Returns:
        Two uint32 arrays of the shape of `coordinate`. Each is a bijection of the coordinate for a fixed key.
    """
    x = coordinate * _WEYL + key[0]
    x = (x ^ (x >> _16)) * _MUL_1 ^ key[1]
    x = (x ^ (x >> _15)) * _MUL_2
    x = x ^ (x >> _15)
    y = (x + key[2]) * _MUL_3
    y = (y ^ (y >> _15)) * _MUL_4 ^ key[3]
    y = (y ^ (y >> _16)) * _MUL_1
    return x, y ^ (y >> _15)


def normal_integers(xp: Any, key: Any, coordinate: Any) -> Any:
    """Normal variates times sqrt(997), as odd int32 in [-251, 251]; shape of `coordinate` (uint32)."""
    x, y = hash_words(key, coordinate)
    ones = xp.bitwise_count(x).astype(np.int32) + xp.bitwise_count(y >> _2).astype(np.int32)
    dither = (y & np.uint32(3)).astype(np.int32)
    return ones * np.int32(8) + dither * np.int32(2) - np.int32(251)


def uniforms(key: Any, coordinate: Any) -> Any:
    """Uniform float32 in [0, 1) on the grid of 2^-24; shape of `coordinate` (uint32)."""
    _, y = hash_words(key, coordinate)
    return (y >> _8).astype(np.float32) * np.float32(2.0**-24)


def normals(key: Keys, count: int) -> NDArray[np.float32]:
    """The first `count` standard normal variates of one stream, in NumPy: coordinates 0 .. count - 1."""
    integers = normal_integers(np, key, np.arange(count, dtype=np.uint32))
    return integers.astype(np.float32) / np.float32(NORMAL_STD)


TEST_VECTORS: tuple[tuple[tuple[int, Domain, int, tuple[int, ...]], tuple[int, ...]], ...] = (
    ((0, Domain.INITIALISATION, 0, (0,)), (-15, 9, 11)),
    ((0, Domain.PARAMETER_NOISE, 0, (0,)), (-9, 7, -21)),
    ((1, Domain.PARAMETER_NOISE, 7, (511,)), (31, -23, -65)),
    ((2**63 - 1, Domain.ACTION_NOISE, 10**6, (4095, 1, 2)), (-13, 1, -1)),
)
"""((seed, domain, generation, ids), `normal_integers` at coordinates 0, 1, 2): what any implementation must give."""
