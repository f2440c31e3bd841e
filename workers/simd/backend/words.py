"""Arrays of lanes as the words that kernels read and write: [block, word, lane]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]
"""[block, word, lane]: floats and integers by their bits, truth as 0 or 1."""
ALIGNMENT = 64


def words_of(aval: Any) -> int:
    """Words of one lane of an array."""
    return math.prod(aval.shape)


def aligned(shape: tuple[int, ...]) -> Words:
    """An empty array of words that vectors can be read from."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(np.uint32).reshape(shape)


def pack(leaves: Sequence[Any], width: int) -> Words:
    """Arrays [lane, ...] as words, one array after the other; lanes that fill the last block repeat the last."""
    lanes = len(leaves[0]) if leaves else 1
    blocks = -(-lanes // width)
    columns = []
    for leaf in leaves:
        array = np.asarray(leaf)
        assert len(array) == lanes, (array.shape, lanes)
        array = array.astype(np.uint32) if array.itemsize < 4 else np.ascontiguousarray(array).view(np.uint32)
        columns.append(array.reshape(lanes, math.prod(array.shape[1:])))
    rows = columns[0] if len(columns) == 1 else np.concatenate([np.zeros((lanes, 0), np.uint32), *columns], axis=1)
    words = aligned((blocks, rows.shape[1], width))
    words[:] = filled(rows, blocks * width).reshape(blocks, width, -1).transpose(0, 2, 1)
    return words


def filled(rows: NDArray, count: int) -> NDArray:
    """As many rows, those that are missing being the last one."""
    return rows if len(rows) == count else rows[np.minimum(np.arange(count), len(rows) - 1)]


def unpack(words: Words, avals: Sequence[Any], lanes: int) -> list[NDArray]:
    """Copies of the arrays [lane, ...] that words are, with the shapes and types of one lane's."""
    rows = words.transpose(0, 2, 1).copy().reshape(len(words) * words.shape[2], words.shape[1])[:lanes]
    found, end = [], 0
    for aval in avals:
        start, end = end, end + words_of(aval)
        column = rows[:, start:end]
        array = column.astype(aval.dtype) if aval.dtype.itemsize < 4 else column.view(aval.dtype)
        found.append(array.reshape(lanes, *aval.shape))
    return found
