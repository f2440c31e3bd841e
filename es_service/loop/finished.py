"""What is stored of a generation: the state after it, its row of the history, and those of what it has evaluated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from es_service.loop.arrays import Changes, changes, names_of
from es_service.loop.budget import MOST_DURATIONS, durations
from es_service.loop.checks import require_known, require_storable
from es_service.loop.clock import Clock
from es_service.loop.correction import Correction
from es_service.loop.evaluated import Evaluations, Proposal, Update, evaluated_table
from es_service.loop.generation import better, fittest
from es_service.loop.history import (
    HistoryRow,
    Table,
    evaluation_columns,
    or_none,
    population_columns,
)
from es_service.loop.interfaces import Search
from es_service.loop.state import RunState
from es_service.protocol.content import Contents
from es_service.search.maps.behaviour_map import EMPTY, map_statistics
from es_service.search.maps.geometry import reachable_cells
from es_service.search.observation_statistics import merge_moments
from es_service.search.steps.clipup import norm

Reachable = NDArray[np.bool_] | None
"""Whether each cell of the map can be reached, [cells]; None if this is unknown."""


@dataclass(frozen=True)
class Finished:
    """A generation that has been computed, and need not be stored yet."""

    before: RunState
    state: RunState
    """State after it."""
    parts: Changes
    """Blocks of arrays that it has changed."""
    contents: Contents
    """The policies and traces that it names and that are new."""
    cell_N: NDArray[np.int64] | None
    """Cells of which those evaluated are the elites, EMPTY for the others; None without a map."""
    proposal: Proposal
    evaluations: Evaluations
    updated: Update
    correction: Correction
    faults: HistoryRow
    seconds: float
    laps: Mapping[str, float]
    """Seconds of the generation, and how they were spent, by history column."""

    @property
    def failures(self) -> Sequence[str]:
        """Texts that name its failed episodes, as far as the rollouts know more of them."""
        results = [*self.evaluations.members, self.updated.evaluated.evaluation]  # policies are in both
        return list(dict.fromkeys(text for result in results for text in result.failures))


def reachable_in(search: Search, state: RunState) -> Reachable:
    """The cells of a run's map that can be reached."""
    return None if state.search.map is None else reachable_cells(state.search.map.geometry, search.task)


def finish(
    before: RunState,
    proposal: Proposal,
    evaluations: Evaluations,
    updated: Update,
    correction: Correction,
    faults: HistoryRow,
    search: Search,
    clock: Clock,
) -> Finished:
    """End a generation with the state after it; `before` is the state before it, which is stored."""
    generation, learned, evaluated = proposal.generation, updated.search, updated.evaluated
    results, per_member = evaluated.evaluation, search.config.task.episodes_per_member
    episodes = sum(population.fitness.size for population in evaluations.populations) * per_member
    cell_N = None if learned.map is None else learned.map.cells_with(generation, evaluated.index_N)
    state = RunState(
        generation=generation,
        search=learned,
        observations=merge_moments(before.observations, evaluations.observed),
        best=better(before.best, updated.told),
        env_steps=before.env_steps + int(evaluated.env_steps_N.sum()) + correction.env_steps,
        episodes=before.episodes + episodes + results.fitness.size + correction.episodes,
        wall_clock_s=clock.total(),
    )
    stored = before if before.generation >= 0 else None
    require_storable(state, stored)
    parts = changes(state, stored)
    named = names_of(parts)
    contents = {name: content for name, content in updated.contents.items() if name in named}
    require_known(named.difference(contents), stored, generation)
    clock.lap("seconds_driver")
    seconds, laps = clock.finish_generation()
    recent = (*before.durations, *durations([{"generation": generation, **laps}]))[-MOST_DURATIONS:]
    state = replace(state, durations=recent)
    computed = proposal, evaluations, updated, correction
    return Finished(before, state, parts, contents, cell_N, *computed, faults, seconds, laps)


def rows(search: Search, finished: Finished, reachable: Reachable) -> tuple[HistoryRow, Table]:
    """A generation's row of the history, and the table of what it has evaluated."""
    state, before, proposal, updated = finished.state, finished.before, finished.proposal, finished.updated
    evaluated, told, cell_N, results = updated.evaluated, updated.told, finished.cell_N, updated.evaluated.evaluation
    table = evaluated_table(evaluated, search.task, cell_N, proposal.start_cells, updated.novelty_N)
    at = fittest(told)  # subject of the history's row
    shown = int(evaluated.index_N[at])
    of_map: HistoryRow = {}
    if state.search.map is not None and cell_N is not None:
        of_map = {
            "start_cell": proposal.start_cells.get(shown),
            "cell": None if cell_N[at] == EMPTY else int(cell_N[at]),
            **map_statistics(state.search.map, search.config.map.qd_offset, reachable),
        }
    row: HistoryRow = {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "episodes": state.episodes,
        "best_fitness": state.best.fitness,
        "centre": shown,
        "fitness_weight": float(evaluated.fitness_weight_N[at]),
        "centre_novelty": or_none(updated.novelty_N[at]),
        "archive_size": state.search.archive.size,
        **of_map,
        **finished.correction.columns,
        "update_norm": or_none(evaluated.update_norm_N[at]),
        "parameter_norm": norm(evaluated.point(at).parameters_D),
        **population_columns(finished.evaluations.members, finished.evaluations.infeasible),
        **({"infeasible_members": finished.evaluations.infeasible} if search.config.search.allow_infeasible else {}),
        **evaluation_columns(table, results, at, search.task),
        **finished.faults,
        "wall_clock_s": state.wall_clock_s,
        "steps_per_second": (state.env_steps - before.env_steps) / finished.seconds,
        **finished.laps,
    }
    return row, table
