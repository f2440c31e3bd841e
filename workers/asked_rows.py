"""What a caller is asked to compute: the episodes of chunks as rows, results of the chunks from what it tells,
and descriptions of the episodes of a chunk whose worker was lost, so that a user can run them alone.

Axes: N rows, D policy parameters, O observation, B descriptor dimensions, T points of a trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.gradient_tree import with_neighbours_added
from es_service.protocol.messages import (
    TRACE_POINTS,
    ChunkResult,
    EpisodesResult,
    EvaluationChunk,
    FloatArray,
    GradientChunk,
    Moments,
    MomentsOfChunks,
    TrainingChunk,
    Work,
    WorkerSpec,
)
from es_service.protocol.noise import KEY_WORDS, seed_of
from es_service.protocol.options import ParameterSpec
from es_service.protocol.policies import explicit
from workers.compiling import Compilable
from workers.policy import gradient_summer, members
from workers.rollouts.backend import ChunkFunctions, Episodes
from workers.worker import Kind, kinds_of


@dataclass(frozen=True)
class Rows:
    """Episodes to compute, one for each row; a member that has several episodes has as many rows."""

    parameters_N_D: FloatArray
    mean_N_O: FloatArray
    std_N_O: FloatArray
    seed_N: NDArray[np.int64]
    action_keys_N_4: NDArray[np.uint32]
    """Keys of the streams of the action noise; not used by rows without noise."""
    is_noisy_N: NDArray[np.bool_]
    """Whether a row is an episode of training, whose actions have noise."""


def gradients(spec: WorkerSpec, work: Sequence[Work]) -> list[ChunkResult]:
    """Results of gradient chunks, which need no episodes."""
    kind = _kinds(spec)[GradientChunk]
    return with_neighbours_added(
        work,
        [
            result
            for subject_chunk in work
            for result in kind.results([subject_chunk], kind.function(*kind.arguments([subject_chunk])))
        ],
    )


def rows_of(spec: WorkerSpec, work: Sequence[Work]) -> Rows:
    """The episodes of chunks, in their order."""
    kinds, parts = _kinds(spec), []
    for subject, chunk in work:
        arguments = kinds[type(chunk)].arguments([(subject, chunk)])
        if isinstance(chunk, TrainingChunk):
            parts.append(_members(spec, *arguments))
        elif isinstance(chunk, EvaluationChunk):
            centre_D, mean_O, std_O, keys_E, is_wanted_E = arguments
            parts.append(_quiet(centre_D, mean_O, std_O, keys_E[is_wanted_E]))
        else:
            policies, mean_L, std_L, policy_L, keys_L = arguments
            parts.append(_quiet(explicit(policies)[policy_L], mean_L, std_L, keys_L))
    return Rows(*(np.ascontiguousarray(np.concatenate(columns)) for columns in zip(*parts, strict=True)))


def results_of(spec: WorkerSpec, work: Sequence[Work], told: EpisodesResult) -> list[ChunkResult]:
    """Results of the chunks of which `rows_of` has made rows.

    Args:
        told: fitness, descriptor and steps of each row, and moments of all observations of the rows with noise.
    """
    kinds, results, first = _kinds(spec), [], 0
    for subject, chunk in work:
        arguments = kinds[type(chunk)].arguments([(subject, chunk)])
        if isinstance(chunk, TrainingChunk):
            is_told = np.ones(arguments[5].shape[:-1], bool)  # of the keys of resets
        elif isinstance(chunk, EvaluationChunk):
            is_told = arguments[4]
        else:
            is_told = np.ones(len(arguments[4]), bool)
        rows = slice(first, first := first + int(is_told.sum()))
        episodes = _episodes(spec, told, rows, is_told, isinstance(chunk, TrainingChunk))
        results += kinds[type(chunk)].results([(subject, chunk)], episodes)
    return _with_moments(results, told.moments)


def _with_moments(results: list[ChunkResult], moments: Moments | MomentsOfChunks | None) -> list[ChunkResult]:
    """The results, of which the first one with moments has all of them, and the others have none."""
    assert isinstance(moments, Moments), "moments of no observation are moments, too"
    for place, result in enumerate(results):
        if isinstance(result, EpisodesResult) and result.moments is not None:
            results[place] = replace(result, moments=moments)
            moments = Moments(0.0, np.zeros_like(moments.mean_O), np.zeros_like(moments.m2_O))
    return results


def _members(
    spec: WorkerSpec,
    centre_D: Any,
    unit: Any,
    mean_O: Any,
    std_O: Any,
    noise_P: Any,
    resets_P_S_E: Any,
    actions_P_S_E: Any,
) -> tuple[Any, ...]:
    """Columns of `Rows`: all episodes of the first member, of the second, ..., from keys [P, S, E, 4]."""
    parameters_M_D = members(spec, centre_D, unit, noise_P).reshape(-1, spec.policy.parameters)
    parameters_N_D = np.repeat(parameters_M_D, resets_P_S_E.shape[2], axis=0)
    columns = _quiet(parameters_N_D, mean_O, std_O, resets_P_S_E.reshape(-1, KEY_WORDS))
    return (*columns[:4], actions_P_S_E.reshape(-1, KEY_WORDS), np.ones(len(parameters_N_D), bool))


def _quiet(parameters: Any, mean: Any, std: Any, keys_N_4: Any) -> tuple[Any, ...]:
    """Columns of `Rows` without noise; what all rows share is repeated."""
    count = len(keys_N_4)
    shared = (np.broadcast_to(array, (count, np.shape(array)[-1])) for array in (parameters, mean, std))
    seeds = np.array([seed_of(key) for key in keys_N_4], np.int64)
    return (*shared, seeds, keys_N_4, np.zeros(count, bool))


def _episodes(spec: WorkerSpec, told: EpisodesResult, rows: slice, is_told: Any, training: bool) -> Episodes:
    """Episodes as from a rollout; the observations are told as moments, so that their sums are 0."""
    descriptor = np.zeros((*is_told.shape, told.descriptor.shape[1]), np.float32)
    fitness, steps = np.zeros(is_told.shape, np.float32), np.zeros(is_told.shape, np.int32)
    fitness[is_told], steps[is_told], descriptor[is_told] = (
        told.fitness[rows],
        told.steps[rows],
        told.descriptor[rows],
    )
    sums = np.zeros((*is_told.shape, spec.policy.widths[0] if training else 0), np.float32)
    points = 0 if training else min(TRACE_POINTS, spec.episode_steps + 1)
    return Episodes(
        fitness=fitness,
        returns=fitness.copy(),
        descriptor=descriptor,
        steps=steps,
        goal_distance=np.full((*is_told.shape, 2), np.nan, np.float32),
        shifted_sum_O=sums,
        shifted_square_sum_O=sums.copy(),
        trace_T_B=np.repeat(descriptor[..., None, :], points, axis=-2),
        outputs={},
        of_steps={},
    )


def _kinds(spec: WorkerSpec) -> dict[Any, Kind]:
    """Kinds of chunks of which only the arguments matter, and the function of gradients."""

    def nothing(*_: Any) -> None:
        return None

    functions = (nothing, nothing, nothing, gradient_summer(spec))
    return kinds_of(spec, ChunkFunctions(*(Compilable(function, nothing) for function in functions)))


SHOWN_ROWS = 4
"""Calls of a function that a description names with their parameters."""
SHOWN_SEEDS = 16
"""Seeds of resets that it names."""


def described(spec: WorkerSpec, parameters: ParameterSpec | None, work: Sequence[Work]) -> str:
    """The parameters and seeds of the calls of a function, or the seeds of the resets of environments, as a sentence.

    Args:
        parameters: those of a function that is the task; None for an environment.
        work: the chunks of a work item.
    """
    if not work or any(isinstance(chunk, GradientChunk) for _, chunk in work):
        return ""
    rows = rows_of(spec, work)
    seeds = rows.seed_N.tolist()
    if parameters is None:
        shown = list(dict.fromkeys(seeds))
        more = f" and {len(shown) - SHOWN_SEEDS} more" if len(shown) > SHOWN_SEEDS else ""
        return f"The resets of its episodes have the seeds {', '.join(map(str, shown[:SHOWN_SEEDS]))}{more}"
    calls = [
        f"{parameters.text(row_D)} (seed {seed})"
        for row_D, seed in zip(rows.parameters_N_D[:SHOWN_ROWS], seeds, strict=False)
    ]
    more = f"; and {len(seeds) - SHOWN_ROWS} more" if len(seeds) > SHOWN_ROWS else ""
    return f"Its calls have {'; '.join(calls)}{more}"
