"""Evaluation and policy chunks in pieces, for tasks whose episodes may take long: each piece can go to another worker.

The numbers of episodes and slots stay those of the whole chunk, and so do the results, as far as the bits of an episode
do not depend on the others that are computed with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from es_service.protocol.episodes import joined
from es_service.protocol.messages import ChunkResult, EpisodesResult, EvaluationChunk, Policies, PolicyChunk, Work
from es_service.protocol.policies import slots


def pieces_of(work: Work, most: int) -> list[Work]:
    """A chunk in pieces with at most `most` episodes each; chunks of training and of gradients are one piece."""
    subject, chunk = work
    if isinstance(chunk, EvaluationChunk):
        starts = range(0, chunk.episodes, most)
        return [
            (subject, replace(chunk, first=chunk.first + start, episodes=min(most, chunk.episodes - start)))
            for start in starts
        ]
    if isinstance(chunk, PolicyChunk) and isinstance(subject, Policies):
        count = len(slots(subject, chunk)[0])
        starts = range(0, count, most)
        return [
            (subject, replace(chunk, first=chunk.first + start, count=min(most, count - start))) for start in starts
        ]
    return [work]


def whole(work: Work, results: Sequence[ChunkResult]) -> ChunkResult:
    """The result of a chunk from those of its pieces."""
    episodes = [one for one in results if isinstance(one, EpisodesResult)]
    if len(results) == 1 or len(episodes) < len(results):
        return results[0]
    traces = [one.trace_T_B for one in episodes if one.trace_T_B is not None]
    found = joined([replace(one, trace_T_B=None) for one in episodes])
    if not traces:
        return found
    return replace(found, trace_T_B=np.concatenate(traces) if isinstance(work[1], PolicyChunk) else traces[0])
