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
from numpy.typing import NDArray

from es_service.loop.checks import valid_members
from es_service.loop.evaluated import Update
from es_service.loop.generation import entered, episodes_of, steps_of
from es_service.loop.history import CORRECTED, HistoryRow, doubles
from es_service.loop.interfaces import Search
from es_service.loop.policies import policy_work
from es_service.loop.state import RunState
from es_service.protocol.evaluator import Requests
from es_service.protocol.messages import EpisodesResult
from es_service.protocol.noise import Domain
from es_service.protocol.recipes import unvaried
from es_service.search.maps.batches import insert_each
from es_service.search.maps.behaviour_map import BehaviourMap, Elite, empty_map, map_statistics

ELITES_AT_ONCE = 256
"""Elites that are evaluated side by side, so that the policies of large maps need not be in memory together. It is part
of the addresses of the resets, and so a constant."""


@dataclass(frozen=True)
class Correction:
    """Columns of the history, and what they have cost."""

    columns: HistoryRow = field(default_factory=dict)
    env_steps: int = 0
    episodes: int = 0


def correct(search: Search, elites: Callable[[int], Elite], before: RunState, updated: Update) -> Requests[Correction]:
    """The corrected columns of a generation; without values where it does not correct, and none if no generation does.

    Args:
        elites: returns the elite of a cell before the generation.
        before: the state before it.
        updated: what the generation has changed.
    """
    settings, map_ = search.config.map, updated.search.map
    if settings.correct_every is None or map_ is None:
        return Correction()
    generation = updated.told.generation
    if generation % settings.correct_every or not map_.size:
        return Correction(dict.fromkeys(CORRECTED))
    evaluated = updated.evaluated
    cell_N = map_.cells_with(generation, evaluated.index_N)
    new = entered(updated.search, cell_N, evaluated.points, evaluated.evaluation.trace_T_B)
    again, steps, episodes = empty_map(map_.geometry), 0, 0
    for ask, first in enumerate(range(0, map_.size, ELITES_AT_ONCE)):
        cells = map_.cell_N[first : first + ELITES_AT_ONCE].tolist()
        kept = [new[cell] if cell in new else elites(_origin(before, map_, cell)) for cell in cells]
        results = yield from _episodes(search, kept, generation, ask)
        with np.errstate(invalid="ignore", over="ignore"):  # an elite with an infinite fitness leaves
            valid_N = np.asarray(valid_members(results).all(axis=1))
            columns = (map_.centre_N[first : first + len(cells)][valid_N], np.full(int(valid_N.sum()), np.nan))
            descriptor_N_B = doubles(results.descriptor).mean(axis=1)[valid_N]
            if valid_N.any():
                fitness_N = doubles(results.fitness).mean(axis=1)[valid_N]
                again = insert_each(again, descriptor_N_B, fitness_N, generation, *columns)
        steps, episodes = steps + steps_of(results), episodes + results.fitness.size
    statistics = map_statistics(again, settings.qd_offset, None)
    values = statistics["coverage"], statistics["qd_score"], statistics["map_fitness_max"]
    return Correction(dict(zip(CORRECTED, values, strict=True)), steps, episodes)


def _origin(before: RunState, map_: BehaviourMap, cell: int) -> int:
    """The cell in which an elite was before the generation."""
    row, earlier = map_.row_of(cell), before.search.map
    assert row is not None
    assert earlier is not None
    origin = earlier.cell_of(int(map_.generation_N[row]), int(map_.centre_N[row]))
    assert origin is not None, "an elite that is neither new nor in the map before"
    return origin


def _episodes(search: Search, elites: list[Elite], generation: int, ask: int) -> Requests[EpisodesResult]:
    """Results of some elites' episodes, [N, E]."""
    statistics: list[NDArray[np.float32]] = [
        np.stack([getattr(elite, name) for elite in elites]) for name in ("observation_mean_O", "observation_std_O")
    ]
    work = policy_work(
        unvaried([elite.centre_D for elite in elites]),
        (statistics[0], statistics[1]),
        search.config.map.correct_episodes,
        seed=search.config.seed,
        generation=generation,
        ask=ask,
        domain=Domain.CORRECTION_RESET,
    )
    return (yield from episodes_of([(work.work, work.shape)]))[0][0]
