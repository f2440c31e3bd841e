"""Results of chunks from their episodes: means over a member's episodes, and the moments of its observations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from es_service.protocol.messages import EpisodesResult, Moments
from workers.rollouts.backend import Episodes


def training_result(episodes: Episodes, shift_O: Any) -> EpisodesResult:
    """Results of a training chunk's members from their episodes [P, S, E].

    They are means over the episodes, except the least goal distance, which is the minimum, and the steps, which are the
    sum. Outputs of steps are those of all episodes.
    """
    host = episodes.map(np.asarray)

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
        outputs={name: mean(array.astype(np.float32)) for name, array in host.outputs.items()},
        of_steps=_valid_steps(host),
    )


def evaluation_result(episodes: Episodes, wanted: int, first: int = 0) -> EpisodesResult:
    """Results of each of `wanted` evaluation episodes, from the episode `first` on, and the trace of that one."""
    result = _episodes_result(episodes.map(lambda array: np.asarray(array)[first : first + wanted]))
    return replace(result, trace_T_B=np.asarray(episodes.trace_T_B)[first].copy())


def policies_result(episodes: Episodes, traced_L: Any) -> EpisodesResult:
    """Results of each episode of a policy chunk [L], with the traces of those in `traced_L` unless that is None."""
    result = _episodes_result(episodes)
    return result if traced_L is None else replace(result, trace_T_B=np.array(episodes.trace_T_B)[traced_L])


def _episodes_result(episodes: Episodes) -> EpisodesResult:
    """Results of single episodes without traces; arrays are copied out of JAX's memory."""
    host = episodes.map(np.array)
    return EpisodesResult(
        fitness=host.fitness,
        returns=host.returns,
        descriptor=host.descriptor,
        steps=host.steps,
        goal_distance=host.goal_distance,
        moments=None,
        outputs=host.outputs,
        of_steps=_valid_steps(host),
    )


def _valid_steps(host: Episodes) -> dict[str, Any]:
    """Outputs of the valid steps of all episodes, [K, ...]: all steps of the first episode, then of the second, ..."""

    def valid(array: Any) -> Any:
        return array[np.arange(array.shape[host.steps.ndim]) < host.steps[..., None]]

    return {name: valid(array) for name, array in host.of_steps.items()}


def _moments(host: Episodes, shift_O: Any) -> Moments:
    """Moments of the observations of all counted steps in valid episodes.

    An episode is invalid if its sums, fitness or descriptor are not finite. All of its observations are left out,
    because they may have been arbitrarily large before.
    """
    size = host.shifted_sum_O.shape[-1]
    sums, squares = (x.reshape(-1, size).astype(np.float64) for x in (host.shifted_sum_O, host.shifted_square_sum_O))
    said = (sums, squares, host.fitness.reshape(-1, 1), host.descriptor.reshape(len(sums), -1))
    valid = np.isfinite(np.concatenate(said, axis=1)).all(axis=1)
    count = float(host.steps.reshape(-1)[valid].sum())
    if count == 0.0:
        return Moments(0.0, np.zeros(size), np.zeros(size))
    mean_O = sums[valid].sum(axis=0) / count
    m2_O = np.maximum(squares[valid].sum(axis=0) - count * np.square(mean_O), 0.0)
    return Moments(count, mean_O + shift_O, m2_O)
