"""Results of episodes array by array: changed, joined, and those of some of several policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from es_service.protocol.messages import EpisodesResult

ARRAYS = "fitness", "returns", "descriptor", "steps", "goal_distance"
"""Arrays that every result has."""
INFEASIBLE = "if -inf says that the point is infeasible, set search.allow_infeasible = true"
"""The end of a message about a fitness of -inf, which is invalid unless the config allows infeasible points."""


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


def joined(results: Sequence[EpisodesResult], count: int | None = None, *, traces: bool = True) -> EpisodesResult:
    """Results along the first axis, one after another, of which the first `count` are kept; without moments. For
    `traces` see `each`."""
    combined = each(lambda *arrays: np.concatenate(arrays)[:count], *results, traces=traces)
    if not (names := results[0].of_steps):
        return combined
    rows = int(combined.steps.sum(dtype=np.int64))
    return replace(
        combined,
        of_steps={name: np.concatenate([result.of_steps[name] for result in results])[:rows] for name in names},
    )


def part_of(results: EpisodesResult, of: int | slice) -> EpisodesResult:
    """The results at an index of the first axis, such as those of one policy [E] from those of all [N, E], or in a
    slice of it that names its start."""
    part = replace(each(lambda array: array[of], results), failures=())  # they do not name their index
    if not results.of_steps:
        return part
    index = of.start if isinstance(of, slice) else of
    first, rows = (int(steps.sum(dtype=np.int64)) for steps in (results.steps[:index], results.steps[of]))
    return replace(part, of_steps={name: array[first : first + rows] for name, array in results.of_steps.items()})
