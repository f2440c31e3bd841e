"""What a generation has evaluated, what the search is told, and what the elites are worth in new episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.loop.checks import valid_members
from es_service.loop.contents import Named, PolicyWork, no_statistics, policy_work
from es_service.loop.generation import episodes_of, first_episode, highest, results_in, steps_of
from es_service.loop.history import CORRECTED, NO_POLICY, RESETS, HistoryRow, Table, doubles, episodes_table, with_gaps
from es_service.loop.state import Search
from es_service.protocol.episodes import Requests, joined
from es_service.protocol.messages import Centre, EpisodesResult, PolicySpec, TaskSpec
from es_service.protocol.noise import Domain
from es_service.search.algorithms.base import Ask, CentreEvaluations, PolicyAsk, SearchState
from es_service.search.maps.behaviour_map import EMPTY, empty_map, insert_each, map_statistics
from es_service.search.steps import norm

_Evaluated = tuple[Centre | PolicyWork, EpisodesResult, Mapping[str, Any]]
"""A centre or an ask for policies, its results [N, E], and its columns [N] by name, of which a single number is that of
all."""


def policies_asked(
    config: RunConfig, task: TaskSpec, generation: int, asks: Sequence[Ask | PolicyAsk]
) -> list[PolicyWork]:
    """The policies among what a search asks for."""
    policies: list[PolicyWork] = []
    populations = sum(isinstance(asked, Ask) for asked in asks)
    for asked in asks:
        if isinstance(asked, PolicyAsk):
            statistics = no_statistics(len(asked.parameters_N_D), task.observation_size)
            if asked.observation_mean_N_O is not None and asked.observation_std_N_O is not None:
                statistics = asked.observation_mean_N_O, asked.observation_std_N_O
            policies.append(
                policy_work(
                    asked.parameters_N_D,
                    statistics,
                    config.search.evaluation_episodes,
                    seed=config.seed,
                    generation=generation,
                    ask=len(policies),
                    request=populations + len(policies),
                    traces=True,
                )
            )
    return policies


def told_of_asks(
    generation: int,
    asks: Sequence[Ask | PolicyAsk],
    new_centres: Iterable[tuple[Centre, EpisodesResult, EpisodesResult]],
    policies: Iterable[tuple[PolicyWork, EpisodesResult]],
    *,
    seed: int,
    centres: int,
    fitness_weight: float,
    spec: PolicySpec,
) -> tuple[CentreEvaluations, Named]:
    """What a search is told of a generation's new centres and policies, in the order of the asks.

    Args:
        new_centres: (centre, its evaluation, its population) of each population asked for.
        policies: (policies, their results [N, E]) of each ask for policies.
        centres: number of centres of the search.
        fitness_weight: weight of fitness in the state.
        spec: of the policies, which their names contain.
    """
    evaluated: list[_Evaluated] = []
    of_centres, of_policies, index = enumerate(new_centres), enumerate(policies), centres
    for asked in asks:
        if isinstance(asked, Ask):
            number, (point, results, population) = next(of_centres)
            columns = {
                "centre": asked.centre,
                "population_max": highest(population.fitness),
                "fitness_weight": asked.fitness_weight,
                "update_norm": norm(point.parameters_D - asked.centre_D),
                "env_steps": steps_of(results) + steps_of(population),
            }
            evaluated.append((point, results, columns | _resets(seed, 0, number, NO_POLICY)))
            continue
        number, (work, results) = next(of_policies)
        number_N = np.arange(len(results.fitness))
        columns = {
            "centre": index + number_N,
            "population_max": math.nan,
            "fitness_weight": fitness_weight,
            "update_norm": math.nan,
            "env_steps": results.steps.sum(axis=1, dtype=np.int64),
        }
        evaluated.append((work, results, columns | _resets(seed, 0, number, number_N)))
        index += len(number_N)
    return _told(generation, evaluated, spec)


def told_of_initial(
    points: Iterable[Centre],
    evaluations: Iterable[EpisodesResult],
    config: RunConfig,
    fitness_weight: float,
    spec: PolicySpec,
) -> tuple[CentreEvaluations, Named]:
    """What a search is told of the initial centres, which have no populations; the episodes of each begin with a chunk
    of its own."""
    evaluated: list[_Evaluated] = []
    for index, (point, results) in enumerate(zip(points, evaluations, strict=True)):
        columns = {
            "centre": index,
            "population_max": math.nan,
            "fitness_weight": fitness_weight,
            "update_norm": math.nan,
            "env_steps": steps_of(results),
        }
        first = first_episode(index, config.search.evaluation_episodes)
        evaluated.append((point, results, columns | _resets(config.seed, first, 0, NO_POLICY)))
    return _told(0, evaluated, spec)


def _resets(*address: Any) -> dict[str, Any]:
    """Columns with the address of the resets of episodes."""
    return dict(zip(RESETS, address, strict=True))


@np.errstate(invalid="ignore", over="ignore")  # an infinite fitness makes the centre invalid
def _told(generation: int, evaluated: Sequence[_Evaluated], spec: PolicySpec) -> tuple[CentreEvaluations, Named]:
    results = [episodes for _, episodes, _ in evaluated]
    episodes = joined(results) if len(results) > 1 else results[0]
    counts = [len(rows.fitness) for _, rows, _ in evaluated]
    columns = {name: _column([of_one[name] for *_, of_one in evaluated], counts) for name in evaluated[0][2]}
    named = Named([subject for subject, *_ in evaluated], episodes.trace_T_B, spec)
    told = CentreEvaluations(
        generation,
        columns.pop("centre"),
        np.asarray(valid_members(episodes).all(axis=1)),
        doubles(episodes.fitness).mean(axis=1),
        doubles(episodes.descriptor).mean(axis=1),
        columns.pop("population_max"),
        episodes.fitness.shape[1],
        episodes,
        named.names,
        columns,
    )
    return told, named


def _column(values: Sequence[Any], counts: Sequence[int]) -> NDArray[Any]:
    """One column of all rows; of some asks one number is that of all of their rows."""
    if not any(map(np.ndim, values)):
        return np.repeat(np.array(values), counts)
    return np.concatenate([np.broadcast_to(column, count) for column, count in zip(values, counts, strict=True)])


def evaluated_table(
    told: CentreEvaluations,
    task: TaskSpec,
    cell_N: NDArray[np.int64] | None,
    start_cells: Mapping[int, int],
    novelty_N: NDArray[np.float64],
) -> Table:
    """The rows of a generation in the table of evaluated centres; see `history.evaluated_columns`.

    Args:
        cell_N: cells of which they are the elites, EMPTY for the others; None without a map.
    """
    episodes, cells = results_in(told), {}
    if cell_N is not None:
        start_N = np.full(told.centre_N.shape, EMPTY)
        for index, cell in start_cells.items():
            start_N[told.centre_N == index] = cell
        cells = {"start_cell": with_gaps(start_N), "cell": with_gaps(cell_N)}
    return {
        "centre": told.centre_N,
        **cells,
        **episodes_table(episodes, task),
        "novelty": novelty_N,
        "fitness_first": episodes.fitness[:, 0],
        **{name: with_gaps(values) if name in RESETS else values for name, values in told.columns.items()},
    }


# What the elites of the map are worth in new episodes: the corrected columns of the history.
#
# Every `map.correct_every` generations, all elites are evaluated in `map.correct_episodes` episodes each, and put into
# an empty map by their mean fitness and their mean descriptor. Elites that were misplaced by luck then collide, so
# coverage falls. Source: the corrected archive of Flageat and Cully 2023 (arXiv:2302.00463). The search learns nothing
# from these episodes, whose resets have a domain of their own. They count as environment steps.
#
# Axes: N elites, E episodes.

ELITES_AT_ONCE = 256
"""Elites that are evaluated side by side, so that the policies of large maps need not be in memory together. It is part
of the addresses of the resets, and so a constant."""


@dataclass(frozen=True)
class Correction:
    """Columns of the history, and what they have cost."""

    columns: HistoryRow = field(default_factory=dict)
    env_steps: int = 0
    episodes: int = 0


def correct(
    search: Search, policies: Callable[[PolicyAsk], PolicyAsk], learned: SearchState, generation: int
) -> Requests[Correction]:
    """The corrected columns of a generation; without values where it does not correct, and none if no generation does.

    Args:
        policies: returns policies that are asked for by name, with their parameters and statistics.
        learned: the search's state after it was told the evaluations of the generation.
    """
    settings, map_ = search.config.map, learned.map
    if settings.correct_every is None or map_ is None:
        return Correction()
    if generation % settings.correct_every or not map_.size:
        return Correction(dict.fromkeys(CORRECTED))
    again, steps, episodes = empty_map(map_.geometry), 0, 0
    for ask, first in enumerate(range(0, map_.size, ELITES_AT_ONCE)):
        rows = slice(first, first + ELITES_AT_ONCE)
        results = yield from _episodes(search, policies(PolicyAsk(map_.policy_N[rows])), generation, ask)
        with np.errstate(invalid="ignore", over="ignore"):  # an elite with an infinite fitness leaves
            valid_N = np.asarray(valid_members(results).all(axis=1))
            columns = (map_.centre_N[rows][valid_N], np.full(int(valid_N.sum()), np.nan))
            descriptor_N_B = doubles(results.descriptor).mean(axis=1)[valid_N]
            if valid_N.any():
                fitness_N = doubles(results.fitness).mean(axis=1)[valid_N]
                again = insert_each(again, descriptor_N_B, fitness_N, generation, *columns)
        steps, episodes = steps + steps_of(results), episodes + results.fitness.size
    statistics = map_statistics(again, settings.qd_offset, None)
    values = statistics["coverage"], statistics["qd_score"], statistics["map_fitness_max"]
    return Correction(dict(zip(CORRECTED, values, strict=True)), steps, episodes)


def _episodes(search: Search, elites: PolicyAsk, generation: int, ask: int) -> Requests[EpisodesResult]:
    mean_N_O, std_N_O = elites.observation_mean_N_O, elites.observation_std_N_O
    assert mean_N_O is not None, "a stored policy has its statistics"
    assert std_N_O is not None
    work = policy_work(
        elites.parameters_N_D,
        (mean_N_O, std_N_O),
        search.config.map.correct_episodes,
        seed=search.config.seed,
        generation=generation,
        ask=ask,
        domain=Domain.CORRECTION_RESET,
    )
    return (yield from episodes_of([(work.work, work.shape)]))[0][0]
