"""The fixed binary tree in which the partial gradients of a population's blocks are added, wherever that happens.

Neighbours are added level by level: ((0 + 1) + (2 + 3)) + ...; an odd last one moves up unchanged. So the node that
covers 2^k blocks begins at a multiple of 2^k, and its bits depend neither on where it was computed nor on how the
blocks were divided among workers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from es_service.protocol.messages import ChunkResult, FloatArray, GradientChunk, GradientResult, Work

ADDED = GradientResult(None, blocks=0)
"""Result of a block that is part of an earlier result."""


def with_neighbours_added(work: Sequence[Work], results: Sequence[ChunkResult]) -> list[ChunkResult]:
    """The results of chunks; those of gradient blocks that form a node of the tree are one sum.

    The sum is at the place of the node's first block, and the others are ADDED. Sums may have been formed before.
    """
    summed = list(results)
    open_nodes: list[int] = []  # places of neighbouring nodes of the same population
    for place, (_, chunk) in enumerate(work):
        result = summed[place]
        if not isinstance(chunk, GradientChunk) or not isinstance(result, GradientResult):
            open_nodes = []
            continue
        if not result.blocks:
            continue
        if open_nodes and not _follows(work[open_nodes[-1]][1], summed[open_nodes[-1]], chunk):
            open_nodes = []
        open_nodes.append(place)
        while len(open_nodes) > 1:
            left, right = open_nodes[-2:]
            sums, more = summed[left], summed[right]
            assert isinstance(sums, GradientResult)
            assert isinstance(more, GradientResult)
            if sums.blocks != more.blocks or work[left][1].chunk_id % (2 * sums.blocks):
                break
            assert sums.sum_D is not None
            assert more.sum_D is not None
            summed[left], summed[right] = GradientResult(sums.sum_D + more.sum_D, 2 * sums.blocks), ADDED
            open_nodes.pop()
    return summed


def _follows(chunk: object, result: ChunkResult, later: GradientChunk) -> bool:
    """Whether a later chunk is the next block of the same population after the node of an earlier one."""
    return (
        isinstance(chunk, GradientChunk)
        and isinstance(result, GradientResult)
        and (chunk.generation, chunk.ask) == (later.generation, later.ask)
        and chunk.chunk_id + result.blocks == later.chunk_id
    )


def tree_sum(nodes: Sequence[GradientResult]) -> FloatArray:
    """Sum over all blocks, from results in the order of the blocks, as `with_neighbours_added` leaves them.

    Raises:
        ValueError: the results are not disjoint nodes that cover all blocks.
    """
    known = {(first, node.blocks): node.sum_D for first, node in enumerate(nodes) if node.blocks}
    covered = 0
    for first, blocks in known:
        if first != covered or first % blocks or blocks & (blocks - 1):
            raise ValueError(
                f"the sum of {blocks} gradient blocks from {first} on is not a node of the tree, or overlaps"
            )
        covered += blocks
    if covered != len(nodes):
        raise ValueError(f"the sums cover {covered} of {len(nodes)} gradient blocks")
    size = 1
    while size < covered:
        size *= 2
    total = _node(known, 0, size, covered)
    assert total is not None, "there is at least one block"
    return total


def _node(known: Mapping[tuple[int, int], FloatArray | None], first: int, size: int, count: int) -> FloatArray | None:
    """Sum of up to `size` blocks from `first` on; None if there are none."""
    if (first, size) in known:
        return known[first, size]
    if first >= count:
        return None
    left, right = (_node(known, start, size // 2, count) for start in (first, first + size // 2))
    return left if right is None or left is None else left + right
