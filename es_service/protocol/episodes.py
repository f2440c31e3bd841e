"""Results of episodes: their addresses, and all rows of a request in one, however they were cut and put together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    EpisodesResult,
    EvaluationChunk,
    Policies,
    PolicyChunk,
    TrainingChunk,
    Work,
)
from es_service.protocol.policies import POLICY_SLOTS, slots

ARRAYS = "fitness", "returns", "descriptor", "steps", "goal_distance"
"""Arrays that every result has."""
INFEASIBLE = "if -inf says that the point is infeasible, set search.allow_infeasible = true"
"""The end of a message about a fitness of -inf, which is invalid unless the config allows infeasible points."""


def addressed(work: Work, result: EpisodesResult, failures: tuple[str, ...] = ()) -> EpisodesResult:
    """The result of a chunk with the address of its rows, and with texts about failed episodes."""
    subject, chunk = work
    if isinstance(chunk, PolicyChunk) and isinstance(subject, Policies):
        policy_L, episode_L = slots(subject, chunk)
        row_N = (subject.first + policy_L) * subject.episodes + episode_L
    elif isinstance(chunk, EvaluationChunk):
        row_N = chunk.chunk_id * EVALUATION_EPISODES_PER_CHUNK + chunk.first + np.arange(chunk.episodes)
    else:
        assert isinstance(chunk, TrainingChunk), f"{type(chunk).__name__} has no episodes"
        size = len(result.fitness)
        row_N = chunk.chunk_id * size + np.arange(size)
    return replace(result, request=chunk.request, row_N=row_N, failures=failures)


def gathered(shapes: Sequence[tuple[int, ...]], results: Sequence[EpisodesResult]) -> list[EpisodesResult]:
    """Results of each request, whose rows may come in any order, without moments.

    Args:
        shapes: leading axes of each request: [pairs] of a population, and [N, E] of the E episodes of N policies, or
            of one centre. Traces are [N, T, B].
        results: those of all requests, with addresses.
    """
    of_request = groupby(sorted(results, key=attrgetter("request")), attrgetter("request"))
    return [_whole(shape, list(rows)) for shape, (_, rows) in zip(shapes, of_request, strict=True)]


def _whole(shape: tuple[int, ...], parts: Sequence[EpisodesResult]) -> EpisodesResult:
    """All rows of a request, in their order."""
    row_N = np.concatenate([part.row_N for part in parts if part.row_N is not None])
    order_N, first = np.argsort(row_N), int(row_N.min())
    in_order = bool((order_N == np.arange(len(order_N))).all())
    assert (row_N[order_N] == first + np.arange(math.prod(shape))).all(), "each row of a request comes once"

    def placed(*arrays: NDArray) -> NDArray:
        flat = np.concatenate(arrays)
        array = (flat if in_order else flat[order_N]).reshape(*shape, *flat.shape[1:])
        if len(shape) > 1 and POLICY_SLOTS < shape[0] < 2 * POLICY_SLOTS:
            # The episodes of a policy are not side by side, as in earlier versions: the bits of means depend on it.
            return array.swapaxes(0, 1).copy().swapaxes(0, 1)
        return array

    combined = each(placed, *parts, traces=False)
    if any(part.trace_T_B is not None for part in parts):
        combined = replace(combined, trace_T_B=_traces(shape[1], first, parts))
    if not parts[0].of_steps:
        return combined
    steps_N = np.concatenate([part.steps.reshape(len(part.steps), -1).sum(axis=1, dtype=np.int64) for part in parts])
    row_K = _ranges((np.cumsum(steps_N) - steps_N)[order_N], steps_N[order_N])
    of_steps = {name: np.concatenate([part.of_steps[name] for part in parts])[row_K] for name in parts[0].of_steps}
    return replace(combined, of_steps=of_steps)


def _traces(episodes: int, first: int, parts: Sequence[EpisodesResult]) -> NDArray:
    """Traces of the first episodes, [N, T, B]: those of a centre are [T, B] in each chunk."""
    rows, traces = [], []
    for part in parts:
        assert part.row_N is not None
        first_rows = part.row_N[(part.row_N - first) % episodes == 0]
        if part.trace_T_B is not None and first_rows.size:
            rows.append(first_rows)
            traces.append(part.trace_T_B.reshape(-1, *part.trace_T_B.shape[-2:]))
    return np.concatenate(traces)[np.argsort(np.concatenate(rows))]


def _ranges(first_N: NDArray[np.int64], count_N: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices from each `first` on, `count` of them, one range after another."""
    return np.repeat(first_N - (np.cumsum(count_N) - count_N), count_N) + np.arange(count_N.sum())


def each(change: Callable[..., np.ndarray], *results: EpisodesResult, traces: bool = True) -> EpisodesResult:
    """A function of the arrays of results with equal names, array by array; without moments and outputs of steps, and
    only if asked for with the traces that all of them have."""
    of_all = [result.trace_T_B for result in results if result.trace_T_B is not None] if traces else []
    return EpisodesResult(
        *(change(*(getattr(result, name) for result in results)) for name in ARRAYS),
        moments=None,
        trace_T_B=change(*of_all) if len(of_all) == len(results) else None,
        outputs={name: change(*(result.outputs[name] for result in results)) for name in results[0].outputs},
        failures=tuple(text for result in results for text in result.failures),
    )


def joined(results: Sequence[EpisodesResult]) -> EpisodesResult:
    """Results of several requests [N, E], one after another; without moments."""
    combined = each(lambda *arrays: np.concatenate(arrays), *results)
    names = results[0].of_steps
    return replace(
        combined, of_steps={name: np.concatenate([result.of_steps[name] for result in results]) for name in names}
    )


def part_of(results: EpisodesResult, index: int) -> EpisodesResult:
    """The results [E] of one policy or centre from those of all [N, E]."""
    part = replace(each(lambda array: array[index], results), failures=())  # they do not name their index
    if not results.of_steps:
        return part
    first, rows = (int(steps.sum(dtype=np.int64)) for steps in (results.steps[:index], results.steps[index]))
    return replace(part, of_steps={name: array[first : first + rows] for name, array in results.of_steps.items()})
