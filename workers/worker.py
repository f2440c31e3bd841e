"""A worker as one function (centre, chunk) -> result. The child process and the Ray actor add only transport.

A worker has no state that a restart would lose: every result is a pure function of its arguments and the spec.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, TypeVar

import numpy as np

from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.messages import (
    EVALUATION_EPISODES_PER_CHUNK,
    Centre,
    Chunk,
    ChunkResult,
    EpisodesResult,
    EvaluationChunk,
    GradientChunk,
    GradientResult,
    Moments,
    Policies,
    PolicyChunk,
    Subject,
    TrainingChunk,
    Work,
    WorkerSpec,
    chunk_name,
)
from es_service.protocol.noise import NORMAL_STD, Domain, Keys, stream_keys
from es_service.protocol.policies import slots
from workers.environments import make_environment
from workers.episode import Episodes

AnyChunk = TypeVar("AnyChunk", TrainingChunk, EvaluationChunk, GradientChunk)
POLICY_CHUNKS_TOGETHER = 8
"""Most policy chunks in one call of the kernel: a call costs little then, and the copies of the weights stay small."""


def make_worker(spec: WorkerSpec) -> Callable[[Sequence[Work]], list[ChunkResult]]:
    """Function from the chunks of a work item to their results; what it uses is compiled at its first call.

    With simd the episodes of neighbouring chunks around one centre run in one call of the kernel, and so do those of a
    few neighbouring policy chunks, since an episode's bits do not depend on the others. With xla they might, so each
    chunk runs alone. A note on an exception names the chunk that raised it. Gradient blocks are added as far as the
    work item has the neighbours.
    """
    environment = make_environment(spec.environment, spec.environment_options)
    if spec.rollout == "simd":
        from workers.simd.episodes import rollout as made_by
    else:
        from workers import rollout as made_by
    training_rollout = made_by.make_training_rollout(environment, spec)
    evaluation_rollout = made_by.make_evaluation_rollout(environment, spec)
    policy_rollout = made_by.make_policy_rollout(environment, spec)
    gradient_sum = made_by.make_gradient_sum(spec.policy.parameters)

    def train(work: Sequence[tuple[Centre, TrainingChunk]]) -> list[ChunkResult]:
        centre, chunks = _around_one(work)
        first, pairs_P = chunks[0], _ids(chunks, spec.chunk_pairs)
        episodes = training_rollout(
            centre.parameters_D,
            np.float32(centre.sigma / NORMAL_STD),
            centre.observation_mean_O,
            centre.observation_std_O,
            stream_keys(spec.seed, Domain.PARAMETER_NOISE, first.generation, pairs_P, *population_id(first)),
            *episode_keys(spec, first.generation, pairs_P, population_id(first)),
        )
        return [_training_result(part, centre.observation_mean_O) for part in _split(episodes, spec.chunk_pairs)]

    def evaluate(work: Sequence[tuple[Centre, EvaluationChunk]]) -> list[ChunkResult]:
        centre, chunks = _around_one(work)
        first, episodes_E = chunks[0], _ids(chunks, EVALUATION_EPISODES_PER_CHUNK)
        episodes = evaluation_rollout(
            centre.parameters_D,
            centre.observation_mean_O,
            centre.observation_std_O,
            stream_keys(spec.seed, Domain.EVALUATION_RESET, first.generation, episodes_E, *population_id(first)),
        )
        return [_evaluation_result(part) for part in _split(episodes, EVALUATION_EPISODES_PER_CHUNK)]

    def gradient(work: Sequence[tuple[Centre, GradientChunk]]) -> list[ChunkResult]:
        _, chunks = _around_one(work)
        first = chunks[0]
        pairs_C_P = _ids(chunks, spec.gradient_block_pairs).reshape(len(chunks), -1)
        keys_C_P = stream_keys(spec.seed, Domain.PARAMETER_NOISE, first.generation, pairs_C_P, *population_id(first))
        return [
            GradientResult(np.array(gradient_sum(chunk.weights_P, keys_P)))
            for chunk, keys_P in zip(chunks, keys_C_P, strict=True)
        ]

    def run_policies(work: Sequence[tuple[Policies, PolicyChunk]]) -> list[ChunkResult]:
        policies, chunk = work[0]
        together = list({id(one): one for one, _ in work}.values())
        ends = accumulate(len(one.parameters_N_D) for one in together)
        first_row = dict(zip(map(id, together), [0, *ends], strict=False))
        slots_C = [slots(*one) for one in work]
        row_L = np.concatenate(
            [first_row[id(one)] + policy_L for (one, _), (policy_L, _) in zip(work, slots_C, strict=True)]
        )
        number_L = np.concatenate([one.first + policy_L for (one, _), (policy_L, _) in zip(work, slots_C, strict=True)])
        episode_L = np.concatenate([episode_L for _, episode_L in slots_C])
        episodes = policy_rollout(
            [one.parameters_N_D for one in together],
            np.concatenate([one.observation_mean_N_O for one in together])[row_L],
            np.concatenate([one.observation_std_N_O for one in together])[row_L],
            row_L,
            stream_keys(policies.seed, Domain.EVALUATION_RESET, chunk.generation, episode_L, number_L, chunk.ask),
        )
        results, start = [], 0
        for (one, _), (_, episode_L) in zip(work, slots_C, strict=True):
            part = Episodes(*(leaf[start : start + len(episode_L)] for leaf in episodes))
            results.append(_policies_result(part, episode_L == 0 if one.traces else None))
            start += len(episode_L)
        return results

    functions: dict[type[Chunk], Callable[[Any], list[ChunkResult]]] = {
        TrainingChunk: train,
        EvaluationChunk: evaluate,
        GradientChunk: gradient,
        PolicyChunk: run_policies,
    }

    def run_group(work: Sequence[Work]) -> list[ChunkResult]:
        try:
            return functions[type(work[0][1])](work)
        except BaseException as error:
            if len(work) == 1:
                error.add_note(f"raised in {chunk_name(work[0][1])}")
                raise
        return [result for one in work for result in run_group([one])]  # to find the one that raises

    def run(work: Sequence[Work]) -> list[ChunkResult]:
        groups = _groups(work, together=spec.rollout == "simd")
        results = [result for group in groups for result in run_group(group)]
        return with_neighbours_added(work, results)

    return run


def _groups(work: Sequence[Work], *, together: bool) -> list[list[Work]]:
    """Neighbouring chunks of one kind around the same centre, and a few of policies; if not `together`, each alone."""
    groups: list[list[Work]] = []
    last = None
    for subject, chunk in work:
        key = (_shared_by(subject), type(chunk), chunk.generation, chunk.ask)
        full = isinstance(subject, Policies) and groups and len(groups[-1]) == POLICY_CHUNKS_TOGETHER
        if together and key == last and not full:
            groups[-1].append((subject, chunk))
        else:
            groups.append([(subject, chunk)])
        last = key
    return groups


def _shared_by(subject: Subject) -> tuple[str, int]:
    """What chunks that run together share: the centre, or the seed of the policies' resets."""
    return ("seed", subject.seed) if isinstance(subject, Policies) else ("centre", id(subject))


def _around_one(work: Sequence[tuple[Centre, AnyChunk]]) -> tuple[Centre, list[AnyChunk]]:
    """(the centre, the chunks) of chunks around one centre."""
    return work[0][0], [chunk for _, chunk in work]


def _ids(chunks: Sequence[Chunk], size: int) -> Any:
    """Ids of the pairs or the episodes of chunks, `size` in each."""
    return np.concatenate([chunk.chunk_id * size + np.arange(size) for chunk in chunks])


def _split(episodes: Episodes, size: int) -> list[Episodes]:
    """Episodes of several chunks as those of each, `size` along the first axis; in JAX's memory if they were."""
    count = len(episodes.fitness) // size
    if count == 1:
        return [episodes]
    return [Episodes(*(leaf[i * size : (i + 1) * size] for leaf in episodes)) for i in range(count)]


def population_id(chunk: Chunk) -> tuple[int, ...]:
    """What a population adds to the addresses of its random streams: nothing for the first of a generation."""
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


def _training_result(episodes: Episodes, shift_O: Any) -> EpisodesResult:
    """Results of a training chunk's members from their episodes [P, S, E].

    They are means over the episodes, except the least goal distance, which is the minimum, and the steps, which are the
    sum.
    """
    host = Episodes(*map(np.asarray, episodes))

    def mean(x_P_S_E: Any) -> Any:
        return x_P_S_E.mean(axis=2) if x_P_S_E.shape[2] > 1 else x_P_S_E[:, :, 0].copy()

    distance_P_S_E = host.goal_distance
    return EpisodesResult(
        fitness=mean(host.fitness),
        returns=mean(host.returns),
        descriptor=mean(host.descriptor),
        steps=host.steps.sum(axis=2, dtype=np.int32),
        goal_distance=np.stack([mean(distance_P_S_E[..., 0]), distance_P_S_E[..., 1].min(axis=2)], axis=-1),
        moments=_moments(host, shift_O),
    )


def _evaluation_result(episodes: Episodes) -> EpisodesResult:
    """Results of each evaluation episode [E] and the trace of the first."""
    result = _episodes_result(episodes)
    return replace(result, trace_T_B=np.array(episodes.trace_T_B[0]))


def _policies_result(episodes: Episodes, traced_L: Any) -> EpisodesResult:
    """Results of each episode of a policy chunk [L], with the traces of those in `traced_L` unless that is None."""
    result = _episodes_result(episodes)
    return result if traced_L is None else replace(result, trace_T_B=np.array(episodes.trace_T_B)[traced_L])


def _episodes_result(episodes: Episodes) -> EpisodesResult:
    """Results of single episodes without traces; arrays are copied out of JAX's memory."""
    host = Episodes(*map(np.array, episodes))
    return EpisodesResult(
        fitness=host.fitness,
        returns=host.returns,
        descriptor=host.descriptor,
        steps=host.steps,
        goal_distance=host.goal_distance,
        moments=None,
    )


def _moments(host: Episodes, shift_O: Any) -> Moments:
    """Moments of the observations of all counted steps in valid episodes.

    An episode is invalid if its sums, fitness or descriptor are not finite. All of its observations are left out,
    because they may have been arbitrarily large before.
    """
    size = host.shifted_sum_O.shape[-1]
    sums, squares = (x.reshape(-1, size).astype(np.float64) for x in (host.shifted_sum_O, host.shifted_square_sum_O))
    said = (sums, squares, host.fitness.reshape(-1, 1), host.descriptor.reshape(len(sums), -1))
    valid = np.logical_and.reduce([np.isfinite(x).all(axis=1) for x in said])
    count = float(host.steps.reshape(-1)[valid].sum())
    if count == 0.0:
        return Moments(0.0, np.zeros(size), np.zeros(size))
    mean_O = sums[valid].sum(axis=0) / count
    m2_O = np.maximum(squares[valid].sum(axis=0) - count * np.square(mean_O), 0.0)
    return Moments(count, mean_O + shift_O, m2_O)
