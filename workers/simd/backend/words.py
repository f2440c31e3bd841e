"""Conversion between arrays [lane, ...] and the words [block, word, lane] that kernels read and write."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]
"""Array [block, word, lane] of the bits of floats and integers; a bool is 0 or 1."""
ALIGNMENT = 64
"""Alignment of arrays of words, in bytes."""


def require(condition: bool, what: str) -> None:
    """Raise ValueError unless a condition of native code is met, which would otherwise use memory that is not its own.

    An assertion would not do, because `python -O` removes it.
    """
    if not condition:
        raise ValueError(f"native code must not be called with these arrays: {what}")


def words_of(aval: Any) -> int:
    """Number of words of one lane of an array."""
    return math.prod(aval.shape)


def aligned(shape: tuple[int, ...]) -> Words:
    """Uninitialised array of words with the alignment that vectors need."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(np.uint32).reshape(shape)


def pack(leaves: Sequence[Any], width: int) -> Words:
    """Words of arrays [lane, ...], one array after the other; the last lane is repeated to fill up the last block."""
    lanes = len(leaves[0]) if leaves else 1
    blocks = -(-lanes // width)
    columns = []
    for leaf in leaves:
        array = np.asarray(leaf)
        require(len(array) == lanes, f"an array has {len(array)} lanes and another {lanes}")
        array = array.astype(np.uint32) if array.itemsize < 4 else np.ascontiguousarray(array).view(np.uint32)
        columns.append(array.reshape(lanes, math.prod(array.shape[1:])))
    rows = columns[0] if len(columns) == 1 else np.concatenate([np.zeros((lanes, 0), np.uint32), *columns], axis=1)
    words = aligned((blocks, rows.shape[1], width))
    words[:] = filled(rows, blocks * width).reshape(blocks, width, -1).transpose(0, 2, 1)
    return words


def filled(rows: NDArray, count: int) -> NDArray:
    """Array of `count` rows; missing rows repeat the last one."""
    return rows if len(rows) == count else rows[np.minimum(np.arange(count), len(rows) - 1)]


def unpack(words: Words, avals: Sequence[Any], lanes: int) -> list[NDArray]:
    """Arrays [lane, ...] of words, as copies; `avals` are the shapes and dtypes of one lane."""
    rows = words.transpose(0, 2, 1).copy().reshape(len(words) * words.shape[2], words.shape[1])[:lanes]
    arrays, end = [], 0
    for aval in avals:
        start, end = end, end + words_of(aval)
        column = rows[:, start:end]
        array = column.astype(aval.dtype) if aval.dtype.itemsize < 4 else column.view(aval.dtype)
        arrays.append(array.reshape(lanes, *aval.shape))
    return arrays
