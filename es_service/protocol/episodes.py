"""Requests for episodes and their results, by address, however they were cut and put together; and the names of outputs
that are computed only where a run names them, each of which is a named array of a result.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Generator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    ChunkResult,
    EpisodesResult,
    EvaluationChunk,
    Moments,
    MomentsOfChunks,
    Policies,
    PolicyChunk,
    Subject,
    TrainingChunk,
    Work,
    recipes_in,
)
from es_service.protocol.policies import POLICY_SLOTS, Recipes, slots

METRICS = "metrics"
"""Output with the metrics that a task records of an episode, [M]: those of `TaskSpec.metric_names`."""
AT_THE_END = ("first_observation", "last_observation", "last_reward", "success", METRICS)
"""Outputs with one value for each episode: the observation of its reset, and what there is after its last valid
step."""
OF_STEPS = ("observation", "action", "reward", "done", "step_descriptor")
"""Outputs with a value for each valid step of an episode."""
TRANSITIONS = (*OF_STEPS, "last_observation")
"""What makes up the transitions of episodes: each step, and where the last one has led."""
METRIC_FORM = "up to 40 letters, digits and _, a letter first"
"""What the name of a metric must be, in words: one of a search, of a task, or of a program that runs a session."""


TAKEN = ("last", "sum", "mean", "min", "max")
"""What a metric of a config may take of the values that a key of `info` has in an episode."""
NAME_OF_METRIC = "[A-Za-z][A-Za-z0-9_]{0,39}"
"""Regular expression of METRIC_FORM."""
CHOSEN_METRIC = f"^{NAME_OF_METRIC}(:({'|'.join(TAKEN)}))?$"
"""Regular expression of a metric that a config chooses: KEY, or KEY:TAKEN."""
ARRAYS = "fitness", "returns", "descriptor", "steps", "goal_distance"
"""Arrays that every result has."""
INFEASIBLE = "if -inf says that the point is infeasible, set search.allow_infeasible = true"
"""The end of a message about a fitness of -inf, which is invalid unless the config allows infeasible points."""


def wrong_metric_names(names: Collection[object]) -> list[str]:
    """Names that no metrics can have, or that differ from another one only in upper and lower case, as columns must
    not."""
    wrong = [repr(name) for name in names if not isinstance(name, str) or not re.fullmatch(NAME_OF_METRIC, name)]
    folded = [str(name).casefold() for name in names]
    return wrong or [repr(name) for name in names if folded.count(str(name).casefold()) > 1]


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
        flat = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
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


def in_blocks(results: Sequence[ChunkResult]) -> list[ChunkResult]:
    """Results of a work item as they travel: those of neighbouring chunks of one request are one, since a message with
    few arrays is read sooner. The moments stay those of each chunk, whose order decides about bits."""
    blocks: list[ChunkResult] = []
    for form, of_form in groupby(results, _form_of_block):
        parts = list(of_form)
        blocks += parts if form is None or len(parts) == 1 else [_block(parts)]
    return blocks


def _form_of_block(result: ChunkResult) -> tuple[object, ...] | None:
    """Request and form of a chunk of episodes without outputs of steps; None for other results, which stay as they
    are."""
    if not isinstance(result, EpisodesResult) or result.of_steps or result.row_N is None:
        return None
    of_centre = result.trace_T_B is not None and result.trace_T_B.ndim == 2
    return result.request, result.moments is None, of_centre, tuple(result.outputs)


def _block(parts: Sequence[Any]) -> EpisodesResult:
    rows = each(lambda *arrays: np.concatenate(arrays), *parts, traces=False)
    row_N, moments = np.concatenate([part.row_N for part in parts]), [part.moments for part in parts]
    return replace(
        rows,
        moments=None if moments[0] is None else MomentsOfChunks.of(moments),
        trace_T_B=_trace_of_block(parts),
        request=parts[0].request,
        row_N=row_N,
    )


def _trace_of_block(parts: Sequence[Any]) -> NDArray | None:
    """Traces of all policies; of a centre that of its first chunk here, since only its first episode's is asked for."""
    traced = [part for part in parts if part.trace_T_B is not None]
    if traced and traced[0].trace_T_B.ndim == 2:
        return min(traced, key=lambda part: part.row_N.min()).trace_T_B
    return np.concatenate([part.trace_T_B for part in traced]) if traced else None


def moments_in(results: Sequence[EpisodesResult]) -> list[Moments]:
    """The moments of each chunk, in the order of the results."""
    found: list[Moments] = []
    for result in results:
        found += result.moments.each() if isinstance(result.moments, MomentsOfChunks) else []
        found += [result.moments] if isinstance(result.moments, Moments) else []
    return found


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


# Requests: generators that yield work and receive its results, and the interface of what computes it.

Value = TypeVar("Value")
Evaluate = Callable[[Sequence[Work]], list[ChunkResult]]
"""Function from chunks to their results, in the order of the chunks."""
Requests = Generator[Sequence[Work], list[ChunkResult], Value]
"""Yields chunks, each time receives their results in the order of the chunks, and returns what it makes of them.

Whoever drives it decides where the chunks are computed: an engine, the caller of `ask_tell`, or a test with a list.
"""

OverlappedRequests = Generator[Sequence[Work] | float, list[ChunkResult] | None, Value]
"""As `Requests`, but in two steps, so that the driver need not wait: it yields chunks to be sent, may store finished
generations once it is resumed, and yields the seconds for which it can wait. It receives the results, or None if they
were not there in time; then it stores these generations, and yields seconds again."""
Wait = Callable[[float], list[ChunkResult] | None]
"""Waits for results at most so many seconds; None if they are not there in time."""


@dataclass(frozen=True)
class DispatchCounts:
    """Numbers of workers and of faults of an evaluator since it was made."""

    retries: int = 0
    """Chunks that were sent again after a fault, including those that a lost worker had not begun. Second copies of
    chunks that a worker was late with do not count."""
    lost_workers: int = 0
    """Workers that were lost, or stopped because of a fault."""
    workers: int = 0
    """Workers that the evaluator is to keep running."""
    rollout_s: float = math.nan
    """Seconds in which workers have computed; NaN if they are not measured."""
    cpu_s: float = math.nan
    """Seconds of the processors of this process and of all its workers; NaN if they are not measured."""


class Evaluator(Protocol):
    """Interface of what computes chunks. Results do not depend on where, in what order or how often."""

    @property
    def counts(self) -> DispatchCounts:
        """Numbers of workers and of faults so far."""
        ...

    def begin(self, work: Sequence[Work]) -> Wait:
        """Have chunks run, and return the function that waits for their results, which `evaluate` returns."""
        ...

    def evaluate(self, work: Sequence[Work]) -> list[ChunkResult]:
        """Results of chunks in the order of `work`.

        Raises:
            EvaluationError: the chunks cannot be computed.
            Interrupted: a stop was requested.
        """
        ...


def completed(requests: Requests[Value], evaluate: Evaluate) -> Value:
    """What a generator of work returns, all of whose work is computed by one function."""
    results: Any = None
    while True:
        try:
            work = requests.send(results)
        except StopIteration as end:
            return end.value
        results = evaluate(work)


# Evaluation and policy chunks in pieces, for tasks whose episodes may take long: each piece can go to another worker.
# And policy chunks that are several in one, for tasks whose episodes take less than a message.
#
# Results know the addresses of their rows (`protocol.episodes`), so nobody needs to know how chunks were cut. They stay
# those of the whole chunks, as far as the bits of an episode do not depend on the others that are computed with it.


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


def together(work: Sequence[Work], most: int) -> list[Work]:
    """A work item as it is sent: neighbouring policies of one ask that are made of recipes and have one episode each
    are one chunk, as far as they are at most `most`, and all recipes have the parents that they need.

    The slots of policies with more episodes, or with observation statistics, stay as they are.
    """
    groups: list[list[Work]] = []
    for subject_chunk in work:
        if groups and _goes_on(groups[-1], subject_chunk, most):
            groups[-1].append(subject_chunk)
        else:
            groups.append([subject_chunk])
    sent: dict[int, Subject] = {}  # by `id`, since chunks with the same policies share them
    merged = []
    for group in groups:
        (subject, chunk), recipes = group[0], [recipes_in(its_subject) for its_subject, _ in group]
        if id(subject) not in sent:
            sent[id(subject)] = subject
            if isinstance(subject, Policies) and recipes[0] is not None:
                sent[id(subject)] = replace(subject, parameters_N_D=_joined(recipes).part(slice(None)))
        if isinstance(chunk, PolicyChunk) and len(group) > 1:
            chunk = replace(chunk, count=sum(len(part) for part in recipes if part is not None))
        merged.append((sent[id(subject)], chunk))
    return merged


def apart(work: Sequence[Work]) -> list[Work]:
    """Policies that were put together for the cores of a worker, in chunks again, which the cores share."""
    chunks: list[Work] = []
    for subject, chunk in work:
        recipes = recipes_in(subject)
        if isinstance(chunk, PolicyChunk) and isinstance(subject, Policies) and recipes and chunk.count > POLICY_SLOTS:
            for first in range(0, chunk.count, POLICY_SLOTS):
                some = recipes.part(slice(first, first + POLICY_SLOTS))
                number = chunk.chunk_id + first // POLICY_SLOTS
                policies = replace(subject, first=subject.first + first, parameters_N_D=some)
                chunks.append((policies, replace(chunk, chunk_id=number, count=POLICY_SLOTS)))
        else:
            chunks.append((subject, chunk))
    return chunks


def _joined(recipes: Sequence[Recipes | None]) -> Recipes:
    """Recipes of one ask, one after another."""
    parts = [part for part in recipes if part is not None]
    if len(parts) == 1:
        return parts[0]
    of_all = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("parent_N_2", "key_N_4")}
    return replace(parts[0], **of_all)


def _goes_on(group: Sequence[Work], work: Work, most: int) -> bool:
    """Whether the policies of a chunk are the next ones after those of a group."""
    (subject, chunk), (before, last), (beginning, _) = work, group[-1], group[0]
    recipes, earlier = recipes_in(subject), recipes_in(before)
    return (
        recipes is not None
        and earlier is not None
        and recipes.names is earlier.names  # those of one ask
        and isinstance(subject, Policies)
        and isinstance(before, Policies)
        and isinstance(beginning, Policies)
        and isinstance(chunk, PolicyChunk)
        and (chunk.part, chunk.first, chunk.count) == (0, 0, POLICY_SLOTS)
        and subject.first + len(recipes) - beginning.first <= most
        and subject.episodes == 1
        and subject.observation_mean_N_O is before.observation_mean_N_O is None
        and vars(subject) == {**vars(before), "first": before.first + len(earlier), "parameters_N_D": recipes}
        and vars(chunk) == {**vars(last), "chunk_id": last.chunk_id + 1}
    )
