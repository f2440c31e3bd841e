"""The process in which xla computes blocks of lanes for `workers.lanes.blocks`.

python -m workers.lanes.process DESCRIPTOR     # of a socket; its parent sets the environment
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import answer_parent
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import OptionValue
from workers.environments import make_environment
from workers.lanes.blocks import BLOCK, LaneResults, lane_functions


class BlockLanes:
    """The lanes of this process, in blocks."""

    def __init__(self, name: str, options: Mapping[str, OptionValue], lanes: int, first: int) -> None:
        """Compile the reset. Arguments are those of `workers.lanes.blocks.Blocks`."""
        begin, step = lane_functions(make_environment(name, options))
        key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
        tree = jax.tree.structure(jax.eval_shape(lambda key: begin(key)[0], key))

        def begun(key: Any) -> tuple[list[Any], LaneResults]:
            carry, seen = begin(key)
            return jax.tree.leaves(carry), seen

        def stepped(arrays: Sequence[Any], action_A: Any) -> tuple[list[Any], LaneResults]:
            carry, seen = step(jax.tree.unflatten(tree, arrays), action_A)
            return jax.tree.leaves(carry), seen

        self._begin, self._step = jax.jit(jax.vmap(begun)), jax.jit(jax.vmap(stepped))
        self._first, self._places = first, np.arange(first, first + lanes)
        blocks = -(-(first + lanes) // BLOCK)
        padding, _ = self._begin(np.zeros((BLOCK, KEY_WORDS), np.uint32))
        self._arrays = [np.concatenate([array] * blocks) for array in map(np.asarray, padding)]
        """Arrays of the carries, [16 * blocks, ...]; those of no lane are some reset."""

    def resets(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], LaneResults]:
        place_M, seen_by_block = self._first + lane_M, []
        for block in np.unique(place_M // BLOCK):
            is_here_M = place_M // BLOCK == block
            here = place_M[is_here_M] % BLOCK
            keys = np.zeros((BLOCK, KEY_WORDS), np.uint32)
            keys[here] = keys_M[is_here_M]
            arrays, seen = self._begin(keys)
            for kept, array in zip(self._arrays, arrays, strict=True):
                kept[place_M[is_here_M]] = np.asarray(array)[here]
            seen_by_block.append([np.asarray(array)[here] for array in seen])
        return self._words_of(place_M), LaneResults(
            *(np.concatenate(arrays) for arrays in zip(*seen_by_block, strict=True))
        )

    def step(self, action_N_A: NDArray[np.float32]) -> LaneResults:
        actions = np.zeros((len(self._arrays[0]), action_N_A.shape[1]), np.float32)
        actions[self._places] = action_N_A
        seen_by_block = []
        for start in range(0, len(actions), BLOCK):
            of = slice(start, start + BLOCK)
            arrays, seen = self._step([array[of] for array in self._arrays], actions[of])
            for kept, array in zip(self._arrays, arrays, strict=True):
                kept[of] = array
            seen_by_block.append(seen)
        return LaneResults(*(np.concatenate(arrays)[self._places] for arrays in zip(*seen_by_block, strict=True)))

    def words(self) -> NDArray[np.uint32]:
        return self._words_of(self._places)

    def put(self, lane_M: NDArray[np.intp], words_M: NDArray[np.uint32]) -> None:
        end = 0
        for kept in self._arrays:
            start, end = end, end + _as_words(kept[:1]).shape[1]
            words = np.ascontiguousarray(words_M[:, start:end])
            of_size = words if kept.itemsize >= 4 else words.astype(f"u{kept.itemsize}")
            kept[self._first + lane_M] = of_size.view(kept.dtype).reshape(len(lane_M), *kept.shape[1:])

    def _words_of(self, place_M: NDArray[np.intp]) -> NDArray[np.uint32]:
        return np.concatenate([_as_words(kept[place_M]) for kept in self._arrays], axis=1)


def _as_words(array_M: NDArray) -> NDArray[np.uint32]:
    """The bits of an array [M, ...] as words [M, words], one for each number of less than 32 bits, as in simd."""
    rows = np.ascontiguousarray(array_M).reshape(len(array_M), -1)
    return rows.view(np.uint32) if rows.itemsize >= 4 else rows.view(f"u{rows.itemsize}").astype(np.uint32)


def _lanes(name: str, *given: Any) -> Any:
    """The function that answers the parent: values of the lanes, by name of the method."""
    lanes = BlockLanes(name, *given)
    return lambda kind, *arguments: getattr(lanes, kind)(*arguments)


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), _lanes)
