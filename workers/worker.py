"""A worker as one function (centre, chunk) -> result. The child process and the Ray actor add only transport.

A worker has no state that a restart would lose: every result is a pure function of its arguments and the spec.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

import numpy as np

from es_service.protocol.episodes import addressed
from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    FAILURES_TOLD,
    Centre,
    Chunk,
    ChunkResult,
    EpisodesResult,
    EvaluationChunk,
    FloatArray,
    GradientChunk,
    GradientResult,
    Policies,
    PolicyChunk,
    Subject,
    TrainingChunk,
    Work,
    WorkerSpec,
    chunk_name,
)
from es_service.protocol.nearest import NOVELTY, ArchiveEntries
from es_service.protocol.noise import NORMAL_STD, Domain, Keys, evaluation_reset_keys, stream_keys
from es_service.protocol.policies import POLICIES_TOGETHER, slots
from workers import progress
from workers.compiling import Compilable
from workers.rollouts import BACKENDS
from workers.rollouts.backend import (
    ChunkFunctions,
    Episodes,
    evaluation_result,
    lane_of,
    policies_result,
    training_result,
)

AnyChunk = TypeVar("AnyChunk", TrainingChunk, EvaluationChunk, GradientChunk)
Thing = TypeVar("Thing")
MOST_KNOWN = 4
"""For the constants of so many runs, a process that stays has compiled functions at most."""


class Made(NamedTuple):
    """What computes the chunks of a run."""

    run_chunks: Compilable
    compiled: set[str]
    """Kinds of chunks for which this process has compiled, for this run or for earlier ones with the same constants."""

    def seconds_to_compile(self, work: Sequence[Work]) -> float:
        """Compile for the kind of some chunks, and say how long it took; 0 if that was done before."""
        kind = type(work[0][1]).__name__
        seconds = 0.0 if kind in self.compiled else self.run_chunks.seconds_to_compile(work)
        self.compiled.add(kind)
        return seconds


def made_before(before: dict[str, Thing], spec: WorkerSpec, make: Callable[[WorkerSpec], Thing]) -> Thing:
    """What was made for the constants of a run, whatever its seed, or is made for them now.

    Args:
        before: what was made for the constants of the last MOST_KNOWN runs, the newest last; it is changed.
    """
    of_any_seed = replace(spec, seed=0)
    name = repr(of_any_seed)
    before[name] = before.pop(name) if name in before else make(of_any_seed)
    for old in list(before)[:-MOST_KNOWN]:
        del before[old]
    return before[name]


def compiled_before(before: dict[str, tuple[ChunkFunctions, set[str]]], spec: WorkerSpec) -> Made:
    """What computes the chunks of a run on one core; `before`: functions and what they were compiled for, as above."""
    functions, compiled = made_before(
        before, spec, lambda of_any_seed: (BACKENDS[spec.rollout].chunk_functions(of_any_seed), set())
    )
    return Made(make_worker(spec, functions), compiled)


class Kind(NamedTuple):
    """How the chunks of one kind are computed; a group of them runs together."""

    function: Compilable
    arguments: Callable[[Any], tuple[Any, ...]]
    """Function from a group of chunks, with their subjects, to the arguments of `function`."""
    results: Callable[[Any, Any], list[ChunkResult]]
    """Function from the group and what `function` has computed to the results of its chunks."""


def make_worker(spec: WorkerSpec, functions: ChunkFunctions | None = None) -> Compilable:
    """Function from the chunks of a work item to their results; `compile` compiles what their kind uses.

    If the rollout takes chunks together, the episodes of neighbouring chunks around one centre run in one call of its
    function, and so do those of a few neighbouring policy chunks; else each chunk runs alone. A note on an exception
    names the chunk that raised it. Gradient blocks are added as far as the work item has the neighbours.

    Args:
        functions: those of the rollout for a spec that is the same but for the seed; None: they are made.
    """
    backend = BACKENDS[spec.rollout]
    kinds = kinds_of(spec, functions or backend.chunk_functions(spec))
    groups = partial(_groups, together=backend.takes_chunks_together)

    def compile_group(kind: Kind, work: Sequence[Work]) -> list[ChunkResult]:
        kind.function.compile(*kind.arguments(work))
        return []

    def run_group(kind: Kind, work: Sequence[Work]) -> list[ChunkResult]:
        return kind.results(work, kind.function(*kind.arguments(work)))

    def named(function: Callable[[Kind, Sequence[Work]], list[ChunkResult]], work: Sequence[Work]) -> list[ChunkResult]:
        try:
            return function(kinds[type(work[0][1])], work)
        except BaseException as error:
            if len(work) == 1:
                lane, place = lane_of(error), chunk_name(work[0][1])
                error.add_note(
                    f"raised in {place if lane is None else f'{lane_name(spec, work[0], lane)}, in {place}'}"
                )
                raise
        return [
            result for subject_chunk in work for result in named(function, [subject_chunk])
        ]  # to find which chunk raises

    def run(work: Sequence[Work]) -> list[ChunkResult]:
        results: list[ChunkResult] = []
        for group in groups(work):
            results += named(run_group, group)
            progress.moved()
        return with_neighbours_added(work, results)

    return Compilable(run, lambda work: [named(compile_group, group) for group in groups(work)])


def kinds_of(spec: WorkerSpec, functions: ChunkFunctions) -> dict[type[Chunk], Kind]:
    """How a run's chunks of each kind are computed."""
    gradient_sum = functions.gradient_sum

    def training_arguments(work: Sequence[tuple[Centre, TrainingChunk]]) -> tuple[Any, ...]:
        centre, chunks = _around_one(work)
        first, pairs_P = chunks[0], _ids(chunks, spec.chunk_pairs)
        return (
            centre.parameters_D,
            np.float32(centre.sigma / NORMAL_STD),
            centre.observation_mean_O,
            centre.observation_std_O,
            stream_keys(spec.seed, Domain.PARAMETER_NOISE, first.generation, pairs_P, *population_id(first)),
            *episode_keys(spec, first.generation, pairs_P, population_id(first)),
        )

    def training_results(work: Sequence[tuple[Centre, TrainingChunk]], episodes: Episodes) -> list[ChunkResult]:
        centre = work[0][0]
        shift_O = centre.observation_mean_O
        parts = zip(work, _split(episodes, spec.chunk_pairs), strict=True)
        results = [_told(spec, subject_chunk, part, training_result(part, shift_O)) for subject_chunk, part in parts]
        return [*results] if centre.archive is None else [*_with_novelty(results, centre.archive)]

    def evaluation_arguments(work: Sequence[tuple[Centre, EvaluationChunk]]) -> tuple[Any, ...]:
        centre, chunks = _around_one(work)
        first, episodes_E = chunks[0], _ids(chunks, EVALUATION_EPISODES_PER_CHUNK)
        return (
            centre.parameters_D,
            centre.observation_mean_O,
            centre.observation_std_O,
            evaluation_reset_keys(spec.seed, first.generation, episodes_E, first.ask),
            np.concatenate([_wanted(chunk) for chunk in chunks]),
        )

    def evaluation_results(work: Sequence[tuple[Centre, EvaluationChunk]], episodes: Episodes) -> list[ChunkResult]:
        parts = _split(episodes, EVALUATION_EPISODES_PER_CHUNK)
        return [
            _told(spec, subject_chunk, part, evaluation_result(part, subject_chunk[1].episodes, subject_chunk[1].first))
            for part, subject_chunk in zip(parts, work, strict=True)
        ]

    def gradient_arguments(work: Sequence[tuple[Centre, GradientChunk]]) -> tuple[Any, ...]:
        _, chunks = _around_one(work)
        first = chunks[0]
        pairs_C_P = _ids(chunks, spec.gradient_block_pairs).reshape(len(chunks), -1)
        keys_C_P = stream_keys(spec.seed, Domain.PARAMETER_NOISE, first.generation, pairs_C_P, *population_id(first))
        return [chunk.weights_P for chunk in chunks], keys_C_P

    def gradient_sums(weights_C_P: Sequence[Any], keys_C_P: Any) -> list[Any]:
        return [gradient_sum(*block) for block in zip(weights_C_P, keys_C_P, strict=True)]

    gradients = Compilable(
        gradient_sums, lambda weights_C_P, keys_C_P: gradient_sum.compile(weights_C_P[0], keys_C_P[0])
    )

    def gradient_results(work: Sequence[Work], sums_C_D: list[Any]) -> list[ChunkResult]:
        return [GradientResult(np.array(sum_D)) for sum_D in sums_C_D]

    return {
        TrainingChunk: Kind(functions.training, training_arguments, training_results),
        EvaluationChunk: Kind(functions.evaluation, evaluation_arguments, evaluation_results),
        GradientChunk: Kind(gradients, gradient_arguments, gradient_results),
        PolicyChunk: Kind(functions.policies, partial(_policy_arguments, spec), partial(_policy_results, spec)),
    }


def _with_novelty(results: Sequence[EpisodesResult], archive: ArchiveEntries) -> list[EpisodesResult]:
    """The results of a centre's training chunks with the novelty of their members."""
    novelty_C = archive.novelty(np.stack([result.descriptor for result in results]))
    return [
        replace(result, outputs={**result.outputs, NOVELTY: novelty_P_S})
        for result, novelty_P_S in zip(results, novelty_C, strict=True)
    ]


def _wanted(chunk: EvaluationChunk) -> Any:
    slot_E = np.arange(EVALUATION_EPISODES_PER_CHUNK)
    return (slot_E >= chunk.first) & (slot_E < chunk.first + chunk.episodes)


def _policy_arguments(spec: WorkerSpec, work: Sequence[tuple[Policies, PolicyChunk]]) -> tuple[Any, ...]:
    policies, chunk = work[0]
    together = list({id(subject): subject for subject, _ in work}.values())
    ends = accumulate(len(subject.parameters_N_D) for subject in together)
    first_row = dict(zip(map(id, together), [0, *ends], strict=False))
    slots_C = [slots(*subject_chunk) for subject_chunk in work]
    row_L = np.concatenate(
        [first_row[id(subject)] + policy_L for (subject, _), (policy_L, _) in zip(work, slots_C, strict=True)]
    )
    number_L = np.concatenate(
        [subject.first + policy_L for (subject, _), (policy_L, _) in zip(work, slots_C, strict=True)]
    )
    episode_L = np.concatenate([episode_L for _, episode_L in slots_C])
    inputs = spec.policy.widths[0]
    return (
        [subject.parameters_N_D for subject in together],
        np.concatenate([_statistics(subject, subject.observation_mean_N_O, 0.0, inputs) for subject in together])[
            row_L
        ],
        np.concatenate([_statistics(subject, subject.observation_std_N_O, 1.0, inputs) for subject in together])[row_L],
        row_L,
        evaluation_reset_keys(policies.seed, chunk.generation, episode_L, chunk.ask, number_L, policies.domain),
    )


def _statistics(policies: Policies, given_N_O: FloatArray | None, value: float, inputs: int) -> FloatArray:
    """Means or standard deviations of the policies' observations; all have one value if none are given."""
    if given_N_O is not None:
        return given_N_O
    return np.full((len(policies.parameters_N_D), inputs), value, np.float32)


def _policy_results(
    spec: WorkerSpec, work: Sequence[tuple[Policies, PolicyChunk]], episodes: Episodes
) -> list[ChunkResult]:
    results, start = [], 0
    for subject, chunk in work:
        _, episode_L = slots(subject, chunk)
        part = episodes.part(slice(start, start + len(episode_L)))
        result = policies_result(part, episode_L == 0 if subject.traces else None)
        results.append(_told(spec, (subject, chunk), part, result))
        start += len(episode_L)
    return results


def lane_name(spec: WorkerSpec, work: Work, lane: int) -> str:
    """Who runs in a lane of a chunk, such as `member + of pair 12`.

    Args:
        lane: as in `FailedEpisode`.
    """
    subject, chunk = work
    population = f" of population {chunk.ask}" if chunk.ask else ""
    if isinstance(chunk, TrainingChunk):
        return f"member {'+-'[lane % 2]} of pair {chunk.chunk_id * spec.chunk_pairs + lane // 2}{population}"
    if isinstance(chunk, EvaluationChunk):
        return f"evaluation episode {chunk.chunk_id * EVALUATION_EPISODES_PER_CHUNK + lane}{population}"
    if isinstance(chunk, PolicyChunk) and isinstance(subject, Policies):
        policy_L, episode_L = slots(subject, chunk)
        asked = f" of ask {chunk.ask}" if chunk.ask else ""
        return f"episode {episode_L[lane]} of policy {subject.first + policy_L[lane]}{asked}"
    raise TypeError(f"{chunk_name(chunk)} has no episodes")


def _told(spec: WorkerSpec, work: Work, episodes: Episodes, result: EpisodesResult) -> EpisodesResult:
    """The result of a chunk with its address, and with the first of its failed episodes by name."""
    told = episodes.failures[:FAILURES_TOLD]
    return addressed(work, result, tuple(f"{lane_name(spec, work, lane)} {text}" for lane, text in told))


def _groups(work: Sequence[Work], *, together: bool) -> list[list[Work]]:
    """Neighbouring chunks of one kind around the same centre, and a few of policies; if not `together`, each alone."""
    groups: list[list[Work]] = []
    last = None
    for subject, chunk in work:
        key = (_shared_by(subject), type(chunk), chunk.generation, chunk.ask)
        full = isinstance(chunk, PolicyChunk) and groups and _slots(groups[-1]) + chunk.count > POLICIES_TOGETHER
        if together and key == last and not full:
            groups[-1].append((subject, chunk))
        else:
            groups.append([(subject, chunk)])
        last = key
    return groups


def _slots(work: Sequence[Work]) -> int:
    """Slots of policy chunks together."""
    return sum(chunk.count for _, chunk in work if isinstance(chunk, PolicyChunk))


def _shared_by(subject: Subject) -> tuple[str, int, int]:
    """Common part of chunks that run together: the centre, or the seed and the domain of the policies' resets."""
    if isinstance(subject, Policies):
        return "policies", subject.seed, subject.domain
    return "centre", id(subject), 0


def _around_one(work: Sequence[tuple[Centre, AnyChunk]]) -> tuple[Centre, list[AnyChunk]]:
    """(the centre, the chunks) of chunks around one centre."""
    return work[0][0], [chunk for _, chunk in work]


def _ids(chunks: Sequence[Chunk], size: int) -> Any:
    return np.concatenate([chunk.chunk_id * size + np.arange(size) for chunk in chunks])


def _split(episodes: Episodes, size: int) -> list[Episodes]:
    """Episodes of several chunks as those of each, `size` along the first axis."""
    if (count := len(episodes.fitness)) == size:
        return [episodes]
    return [episodes.part(slice(first, first + size)) for first in range(0, count, size)]


def population_id(chunk: Chunk) -> tuple[int, ...]:
    """Ids of a population in the addresses of its random streams: none for the first of a generation."""
    return (chunk.ask,) if chunk.ask else ()


def episode_keys(spec: WorkerSpec, generation: int, pairs_P: Any, population: tuple[int, ...] = ()) -> Keys:
    """Stream keys of training episodes, with axes [resets or action noise, P, S, E, 4].

    With common random numbers, both members of a pair have the same keys.
    """
    sign_S = np.zeros(2, int) if spec.common_random_numbers else np.arange(2)
    domains = (Domain.TRAINING_RESET, Domain.ACTION_NOISE)
    episode_E = np.arange(spec.episodes_per_member)
    ids = (pairs_P[:, None, None], sign_S[None, :, None], episode_E, *population)
    return stream_keys(spec.seed, domains, generation, *ids)
