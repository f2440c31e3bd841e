"""The random number generator of the project: counter-based, with the same bits in NumPy, XLA and compiled kernels.

A random number is a pure function of its address. It is computed again wherever it is needed, and never sent, stored
or drawn from a generator with a state. An address has two parts:

* the *stream*: (run seed, domain, generation, ids ...), hashed here in 64-bit NumPy into a key of four words;
* the *coordinate*: a uint32 counter inside the stream (a policy parameter, a control step x action, ...), hashed with
  the key by `hash_words`. It uses 32-bit integer operations only, which are exact in NumPy, XLA and vector units.

A normal variate is made from a count of bits: 62 hashed bits are counted, and 2 more bits divide each step of the count
into quarters: `k = 8 * ones + 2 * dither - 251`, an odd integer with |k| <= 251. Its standard deviation is exactly
sqrt(997), so `k / sqrt(997)` has mean 0, variance 1, skewness 0, excess kurtosis -0.032, and |x| <= 7.95. Its values
are 0.063 standard deviations apart. `k` is exact in int8 (as (k - 1) / 2), in bfloat16 and in float32, so the rollout
and the gradient do not depend on the type in which it is stored.

Functions for both the driver and the workers take the array namespace as `xp` (numpy or jax.numpy).
"""

from __future__ import annotations

import hashlib
import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Keys = NDArray[np.uint32]
"""Stream keys [..., 4]: leading axes of the ids that they were made from, then the four words of a key."""

NORMAL_STD = math.sqrt(997.0)
"""Standard deviation of `normal_integers`: sqrt(64 * 62 / 4 + 5)."""
KEY_WORDS = 4
"""uint32 words in a stream key."""


class Domain(IntEnum):
    """Purpose of a stream. Different purposes never share a stream."""

    INITIALISATION = 0
    PARAMETER_NOISE = 1
    TRAINING_RESET = 2
    EVALUATION_RESET = 3
    ACTION_NOISE = 4
    SELECTION = 5
    VARIATION = 6
    CANDIDATE_RESET = 7
    """Resets of episodes that choose among the candidates of a certification."""
    CERTIFICATION_RESET = 8
    """Resets of episodes that only report the value of what was chosen."""
    ENVIRONMENT_RESET = 9
    """Resets of our tasks as environments of other libraries."""
    CORRECTION_RESET = 10
    """Resets of episodes that say what the elites of a map are worth, from which the search learns nothing."""
    DECISION_RESET = 11
    """Resets of episodes that decide whether a run has reached `budget.target_certified`."""
    OTHER_TASK_RESET = 12
    """Resets of episodes that report the value of a policy in another task and, for the gap, in its own; their seed is
    `seed_for` the other task."""


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_HALVES = _GOLDEN * np.arange(1, 3, dtype=np.uint64)
_MASK = 2**64 - 1
_WEYL, _MUL_1, _MUL_2, _MUL_3, _MUL_4 = (
    np.uint32(word) for word in (0x9E3779B9, 0x21F0AAAD, 0xD35A2D97, 0x85EBCA6B, 0xC2B2AE35)
)
_2, _8, _15, _16 = np.uint32(2), np.uint32(8), np.uint32(15), np.uint32(16)


def _mix64(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Bijection of 64-bit words in which each input bit affects all output bits (the finaliser of splitmix64)."""
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return x ^ (x >> np.uint64(31))


def _mix(x: int) -> int:
    """Scalar version of `_mix64` in Python integers; avoids NumPy's call overhead."""
    x = (x ^ (x >> 30)) * int(_MIX_1) & _MASK
    x = (x ^ (x >> 27)) * int(_MIX_2) & _MASK
    return x ^ (x >> 31)


def stream_keys(seed: int, domain: Domain | tuple[Domain, ...], generation: int, *ids: Any) -> Keys:
    """Keys of the streams (seed, domain, generation, *ids).

    Args:
        domain: one domain, or a tuple of domains, for which the result has an additional first axis.
        ids: ints or integer arrays that broadcast together.

    Returns:
        uint32 array of the broadcast shape of `ids` + (4,). Keys of streams that differ only in the last id never
        collide.

    Raises:
        OverflowError: the seed, the domain or the generation is not an unsigned 64-bit integer.
    """
    domains = domain if isinstance(domain, tuple) else (domain,)
    # There is always an axis of domains, because NumPy warns when a scalar wraps around, but not when an array does.
    state = np.array([_prefix(seed, each_domain, generation) for each_domain in domains], np.uint64)
    state = state.reshape(-1, *[1] * max(map(np.ndim, ids), default=0))
    for field in ids:
        state = _mix64((state ^ np.asarray(field, np.uint64)) + _GOLDEN)
    halves = _mix64(state[..., None] + _HALVES)
    words = halves.astype("<u8", copy=False).view("<u4")  # the lower half of each 64-bit word comes first
    return words if isinstance(domain, tuple) else words[0]


def seed_for(seed: int, name: str) -> int:
    """Seed below 2^63 of the streams of a run that belong to something with a name."""
    return int.from_bytes(hashlib.sha256(f"{seed}\0{name}".encode()).digest()[:8], "little") >> 1


def evaluation_reset_keys(
    seed: int,
    generation: int,
    episode: Any,
    ask: int = 0,
    policy: Any = None,
    domain: Domain = Domain.EVALUATION_RESET,
) -> Keys:
    """Keys of the streams of the resets of evaluation episodes.

    Args:
        episode: number of the episode among those of the centre or of the policy; the initial centres number theirs
            on.
        ask: number of the ask in its generation, where populations and policies are counted separately.
        policy: number of the policy in its ask; None for a centre.
        domain: purpose of the episodes.
    """
    ids = (episode, *((ask,) if ask else ())) if policy is None else (episode, policy, ask)
    return stream_keys(seed, domain, generation, *ids)


def _prefix(seed: int, domain: Domain, generation: int) -> int:
    """State of the hash of a stream's address before its ids."""
    state = 0
    for field in (int(seed), int(domain), int(generation)):
        if not 0 <= field <= _MASK:
            raise OverflowError(f"the seed, domain or generation {field} is not between 0 and 2^64 - 1")
        state = _mix((state ^ field) + int(_GOLDEN) & _MASK)
    return state


def hash_words(key: Any, coordinate: Any) -> tuple[Any, Any]:
    """Two hashed words for each coordinate of one stream.

    Args:
        key: uint32 [4].
        coordinate: uint32 array of any shape.

    Returns:
        Two uint32 arrays of the shape of `coordinate`. For a fixed key, each is a bijection of the coordinate.
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
    """Standard normal variates times sqrt(997): odd int32 in [-251, 251], in the shape of `coordinate` (uint32)."""
    x, y = hash_words(key, coordinate)
    ones = xp.bitwise_count(x).astype(np.int32) + xp.bitwise_count(y >> _2).astype(np.int32)
    dither = (y & np.uint32(3)).astype(np.int32)
    return ones * np.int32(8) + dither * np.int32(2) - np.int32(251)


def uniforms(key: Any, coordinate: Any) -> Any:
    """Uniform variates: float32 multiples of 2^-24 in [0, 1), in the shape of `coordinate` (uint32)."""
    _, y = hash_words(key, coordinate)
    return (y >> _8).astype(np.float32) * np.float32(2.0**-24)


def normals(keys: Keys, count: int) -> NDArray[np.float32]:
    """Standard normal variates of streams at coordinates 0 to count - 1, in NumPy.

    They are those of `normal_integers`, computed in place and for as many streams at a time as stay in the cache.

    Args:
        keys: keys of the streams [..., 4].

    Returns:
        float32 of the leading axes of `keys`, [..., count].
    """
    key_N_4 = keys.reshape(-1, KEY_WORDS)
    variate_N_C = np.empty((len(key_N_4), count), np.float32)
    weyl_C = np.arange(count, dtype=np.uint32) * _WEYL
    rows = max(1, _CACHED_WORDS // max(1, count))
    x_R_C, y_R_C = np.empty((2, min(rows, len(key_N_4)), count), np.uint32)
    for first in range(0, len(key_N_4), rows):
        part = slice(first, first + rows)
        key = key_N_4[part].T[..., None]
        x, y = (buffer[: len(key_N_4[part])] for buffer in (x_R_C, y_R_C))
        np.add(weyl_C, key[0], out=x)
        x ^= np.right_shift(x, _16, out=y)
        x *= _MUL_1
        x ^= key[1]
        x ^= np.right_shift(x, _15, out=y)
        x *= _MUL_2
        x ^= np.right_shift(x, _15, out=y)
        ones = np.bitwise_count(x)
        x += key[2]
        x *= _MUL_3
        x ^= np.right_shift(x, _15, out=y)
        x *= _MUL_4
        x ^= key[3]
        x ^= np.right_shift(x, _16, out=y)
        x *= _MUL_1
        x ^= np.right_shift(x, _15, out=y)
        ones += np.bitwise_count(np.right_shift(x, _2, out=y))
        ones <<= np.uint8(2)
        x &= np.uint32(3)
        np.add(ones, x, out=ones, casting="unsafe")  # at most 4 * 62 + 3
        np.take(_VARIATES, ones, out=variate_N_C[part], mode="wrap")
    return variate_N_C.reshape(*keys.shape[:-1], count)


_CACHED_WORDS = 1 << 15
"""Words of each of the two arrays of `normals`, which then stay in the second cache of a core."""
_VARIATES = np.arange(-251, 252, 2, dtype=np.int32).astype(np.float32) / np.float32(NORMAL_STD)
"""Every value of a normal variate, by 4 * ones + dither."""


TEST_VECTORS: tuple[tuple[tuple[int, Domain, int, tuple[int, ...]], tuple[int, ...]], ...] = (
    ((0, Domain.INITIALISATION, 0, (0,)), (-15, 9, 11)),
    ((0, Domain.PARAMETER_NOISE, 0, (0,)), (-9, 7, -21)),
    ((1, Domain.PARAMETER_NOISE, 7, (511,)), (31, -23, -65)),
    ((2**63 - 1, Domain.ACTION_NOISE, 10**6, (4095, 1, 2)), (-13, 1, -1)),
)
"""Values that every implementation must give: (seed, domain, generation, ids) and `normal_integers` at coordinates 0,
1, 2."""


def seed_of(reset_key_4: NDArray[np.uint32]) -> int:
    """The seed of a reset, a whole number below 2^31, which every generator accepts, from its stream key."""
    return int(reset_key_4[0]) >> 1
