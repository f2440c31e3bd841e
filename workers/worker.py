"""A worker as one function (centre, chunk) -> result. The child process and the Ray actor add only transport.

A worker has no state that a restart would lose: every result is a pure function of its arguments and the spec.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

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
    TrainingChunk,
    Work,
    WorkerSpec,
    chunk_name,
)
from es_service.protocol.noise import NORMAL_STD, Domain, Keys, stream_keys
from workers.environments import make_environment
from workers.episode import Episodes


def make_worker(spec: WorkerSpec) -> Callable[[Centre, Chunk], ChunkResult]:
    """Function (centre, chunk) -> result of a run; the functions that it uses are compiled at their first call."""
    environment = make_environment(spec.environment, spec.environment_options)
    if spec.rollout == "simd":
        from workers.simd.episodes import rollout as made_by
    else:
        from workers import rollout as made_by
    training_rollout = made_by.make_training_rollout(environment, spec)
    evaluation_rollout = made_by.make_evaluation_rollout(environment, spec)
    gradient_sum = made_by.make_gradient_sum(spec.policy.parameters)

    def train(centre: Centre, chunk: TrainingChunk) -> EpisodesResult:
        pairs_P = chunk.chunk_id * spec.chunk_pairs + np.arange(spec.chunk_pairs)
        episodes = training_rollout(
            centre.parameters_D,
            np.float32(centre.sigma / NORMAL_STD),
            centre.observation_mean_O,
            centre.observation_std_O,
            stream_keys(spec.seed, Domain.PARAMETER_NOISE, chunk.generation, pairs_P, *population_id(chunk)),
            *episode_keys(spec, chunk.generation, pairs_P, population_id(chunk)),
        )
        return _training_result(episodes, centre.observation_mean_O)

    def evaluate(centre: Centre, chunk: EvaluationChunk) -> EpisodesResult:
        episodes_E = chunk.chunk_id * EVALUATION_EPISODES_PER_CHUNK + np.arange(EVALUATION_EPISODES_PER_CHUNK)
        episodes = evaluation_rollout(
            centre.parameters_D,
            centre.observation_mean_O,
            centre.observation_std_O,
            stream_keys(spec.seed, Domain.EVALUATION_RESET, chunk.generation, episodes_E, *population_id(chunk)),
        )
        return _evaluation_result(episodes)

    def gradient(chunk: GradientChunk) -> GradientResult:
        pairs_P = chunk.chunk_id * spec.gradient_block_pairs + np.arange(spec.gradient_block_pairs)
        keys_P = stream_keys(spec.seed, Domain.PARAMETER_NOISE, chunk.generation, pairs_P, *population_id(chunk))
        return GradientResult(np.array(gradient_sum(chunk.weights_P, keys_P)))

    def run_chunk(centre: Centre, chunk: Chunk) -> ChunkResult:
        match chunk:
            case TrainingChunk():
                return train(centre, chunk)
            case EvaluationChunk():
                return evaluate(centre, chunk)
            case GradientChunk():
                return gradient(chunk)

    return run_chunk


def run_chunks(run_chunk: Callable[[Centre, Chunk], ChunkResult], work: Sequence[Work]) -> list[ChunkResult]:
    """Results of the chunks of one work item; a note on an exception names the chunk that raised it."""
    results = []
    for centre, chunk in work:
        try:
            results.append(run_chunk(centre, chunk))
        except BaseException as error:
            error.add_note(f"raised in {chunk_name(chunk)}")
            raise
    return results


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
    """Results of each evaluation episode [E] and the trace of the first; arrays are copied out of JAX's memory."""
    host = Episodes(*map(np.array, episodes))
    return EpisodesResult(
        fitness=host.fitness,
        returns=host.returns,
        descriptor=host.descriptor,
        steps=host.steps,
        goal_distance=host.goal_distance,
        moments=None,
        trace_T_B=host.trace_T_B[0].copy(),
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
