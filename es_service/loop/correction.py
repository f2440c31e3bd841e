"""What the elites of the map are worth in new episodes: the corrected columns of the history.

Every `map.correct_every` generations, all elites are evaluated in `map.correct_episodes` episodes each, and put into an
empty map by their mean fitness and their mean descriptor. Elites that were misplaced by luck then collide, so coverage
falls. Source: the corrected archive of Flageat and Cully 2023 (arXiv:2302.00463). The search learns nothing from these
episodes, whose resets have a domain of their own. They count as environment steps.

Axes: N elites, E episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from es_service.loop.checks import valid_members
from es_service.loop.generation import episodes_of, steps_of
from es_service.loop.history import CORRECTED, HistoryRow, doubles
from es_service.loop.interfaces import Search
from es_service.loop.policies import policy_work
from es_service.protocol.evaluator import Requests
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.noise import Domain
from es_service.search.algorithms.base import PolicyAsk, SearchState
from es_service.search.maps.behaviour_map import empty_map, insert_each, map_statistics

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
    """Results of some elites' episodes, [N, E]."""
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
