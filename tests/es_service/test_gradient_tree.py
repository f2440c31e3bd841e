"""Gradient blocks are added wherever neighbours meet; the bits are those of adding all of them in one place."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol.gradient_tree import ADDED, tree_sum, with_neighbours_added
from es_service.protocol.messages import EvaluationChunk, GradientChunk, GradientResult
from tests.helpers import centre, random_parameters

POINT = centre(random_parameters())
WEIGHTS = np.zeros(1, np.float32)


def level_by_level(blocks):
    """The definition: neighbours are added, an odd last one moves up unchanged."""
    while len(blocks) > 1:
        pairs = [blocks[i] + blocks[i + 1] for i in range(0, len(blocks) - 1, 2)]
        blocks = pairs + blocks[len(pairs) * 2 :]
    return blocks[0]


def blocks_of(count, seed=0):
    """Sums that come out otherwise in almost any other order."""
    random = np.random.default_rng(seed)
    return [(random.normal(size=3) * 10.0 ** random.integers(-6, 7)).astype(np.float32) for _ in range(count)]


def cut(items, at):
    places = sorted({0, len(items), *(place % (len(items) + 1) for place in at)})
    return [items[start:end] for start, end in pairwise(places)]


@given(st.integers(1, 70), st.lists(st.integers(0, 1000)), st.lists(st.integers(0, 1000)), st.integers(0, 99))
def test_bits_are_those_of_one_place_however_the_blocks_are_divided(count, items, parts, seed):
    """Into work items, and those into the parts of several cores."""
    blocks = blocks_of(count, seed)
    found = []
    for item in cut([(GradientChunk(1, i, WEIGHTS), block) for i, block in enumerate(blocks)], items):
        work, results = [(POINT, chunk) for chunk, _ in item], []
        for part in cut(list(item), parts):
            some = [(POINT, chunk) for chunk, _ in part]
            results += with_neighbours_added(some, [GradientResult(block) for _, block in part])
        again = with_neighbours_added(work, results)
        assert sum(result is not ADDED for result in again) <= 2 * len(item).bit_length()
        found += again
    assert tree_sum(found).tobytes() == level_by_level(blocks).tobytes()


def test_a_whole_population_is_one_sum_and_others_are_left_alone():
    ids = [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1), (1, 3)]  # (population, block); the last has no neighbour
    work = [(POINT, GradientChunk(1, block, WEIGHTS, ask)) for ask, block in ids]
    found = with_neighbours_added(work, [GradientResult(block) for block in blocks_of(7)])
    assert [result.blocks for result in found] == [4, 0, 0, 0, 2, 0, 1]
    other = [(POINT, EvaluationChunk(1, 0)), (POINT, GradientChunk(1, 1, WEIGHTS))]
    results = [object(), GradientResult(blocks_of(1)[0])]
    assert with_neighbours_added(other, results) == results


@pytest.mark.parametrize("other", [(1, 1), (2, 0)])
def test_blocks_of_two_populations_or_generations_are_never_added(other):
    """Also if their numbers follow each other."""
    generation, ask = other
    work = [(POINT, GradientChunk(1, 0, WEIGHTS)), (POINT, GradientChunk(generation, 1, WEIGHTS, ask))]
    results = [GradientResult(block) for block in blocks_of(2)]
    assert with_neighbours_added(work, results) == results


@pytest.mark.parametrize(
    "blocks",
    [[1, 1, 0], [2, 1, 1], [2, 1, 1, 0], [1, 2, 0], [0, 1, 1], [3, 0, 0], [4, 0, 0]],
    ids=lambda blocks: str(blocks),
)
def test_sums_that_overlap_are_no_node_or_leave_a_block_out_are_refused(blocks):
    nodes = [GradientResult(np.ones(1, np.float32) if count else None, count) for count in blocks]
    with pytest.raises(ValueError, match="gradient blocks"):
        tree_sum(nodes)
