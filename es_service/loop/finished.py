"""What is stored of a generation: the state after it, its row of the history, and those of what it has evaluated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.loop.blocks import changes
from es_service.loop.budget import MOST_DURATIONS, Clock, durations
from es_service.loop.checks import require_known, require_storable
from es_service.loop.contents import Named
from es_service.loop.evaluated import Correction, evaluated_table
from es_service.loop.generation import better, fittest, results_in
from es_service.loop.history import (
    METRIC,
    HistoryRow,
    Table,
    evaluation_columns,
    or_none,
    population_columns,
)
from es_service.loop.state import Changes, RunState, Search, merge_moments
from es_service.protocol.content import Contents
from es_service.protocol.messages import EpisodesResult, Moments
from es_service.search.algorithms.base import CentreEvaluations, SearchState
from es_service.search.maps.behaviour_map import EMPTY, map_statistics
from es_service.search.maps.geometry import reachable_cells, tessellation
from es_service.search.novelty import NoveltyArchive, novelty
from es_service.search.steps import norm

Reachable = NDArray[np.bool_] | None
"""Whether each cell of the map can be reached, [cells]; None if this is unknown."""


class Members(NamedTuple):
    """What the rollouts of a generation have given; nothing in generation 0."""

    results: Sequence[EpisodesResult] = ()
    """Of each population [P, S] and of each ask for policies [N], which are members, too. The fitness of invalid and of
    infeasible ones is NaN."""
    observed: Sequence[Moments] = ()
    """Moments of the populations' observations, in the order in which they are merged."""
    infeasible: int = 0
    """Number of members that are infeasible."""
    of_populations: int = 0
    """Number of members of populations."""


@dataclass(frozen=True)
class Finished:
    """A generation that has been computed, and need not be stored yet."""

    before: RunState
    state: RunState
    """State after it."""
    start_cells: Mapping[int, int]
    """Index of a centre -> cell of the elite from which it has restarted."""
    members: Members
    told: CentreEvaluations
    """What the search was told of the new centres and the policies. N: each of them."""
    named: Named
    """Which policies these are."""
    archive: NoveltyArchive | None
    """The novelty archive before the search was told of them, by which their novelty is stored; None for initial
    centres."""
    cell_N: NDArray[np.int64] | None
    """Cells of which they are the elites, EMPTY for the others; None without a map."""
    columns: HistoryRow
    """Further columns of the history: corrected values, faults, and how its seconds were spent."""
    seconds: float

    @cached_property
    def _changed(self) -> tuple[Changes, Contents]:
        stored = self.before if self.before.generation >= 0 else None
        parts, names = changes(self.state, stored)
        contents = {name: content for name, content in self.named.contents.items() if name in names}
        require_known(names.difference(contents), stored, self.told.generation)
        return parts, contents

    @property
    def parts(self) -> Changes:
        """Blocks of arrays that it has changed; they are found when it is stored, while the next one is computed."""
        return self._changed[0]

    @property
    def contents(self) -> Contents:
        """The policies and traces that it names and that are new."""
        return self._changed[1]

    @property
    def failures(self) -> Sequence[str]:
        """Texts that name its failed episodes, as far as the rollouts know more of them."""
        results = [*self.members.results, results_in(self.told)]  # policies are in both
        return list(dict.fromkeys(text for result in results for text in result.failures))


def reachable_in(search: Search, state: RunState) -> Reachable:
    """The cells of a run's map, or of the grid by which its coverage is counted, that can be reached."""
    return None if state.search.map is None else reachable_cells(tessellation(state.search.map.geometry), search.task)


def finish(
    before: RunState,
    learned: SearchState,
    start_cells: Mapping[int, int],
    members: Members,
    told: CentreEvaluations,
    named: Named,
    archive: NoveltyArchive | None,
    correction: Correction,
    faults: HistoryRow,
    search: Search,
    clock: Clock,
) -> Finished:
    """End a generation with the state after it.

    Args:
        before: the state before it, which is stored.
        learned: the search's state after it was told the evaluations.
    """
    generation, results = told.generation, results_in(told)
    trained = members.of_populations * search.config.task.episodes_per_member
    cell_N = None if learned.map is None else learned.map.cells_with(generation, told.centre_N)
    state = RunState(
        generation=generation,
        search=learned,
        observations=merge_moments(before.observations, members.observed),
        best=better(before.best, told),
        env_steps=before.env_steps + int(told.columns["env_steps"].sum()) + correction.env_steps,
        episodes=before.episodes + trained + results.fitness.size + correction.episodes,
        wall_clock_s=clock.total(),
    )
    require_storable(state, before if before.generation >= 0 else None)
    clock.lap("seconds_driver")
    seconds, laps = clock.finish_generation()
    recent = (*before.durations, *durations([{"generation": generation, **laps}]))[-MOST_DURATIONS:]
    state = replace(state, durations=recent)
    columns = {**correction.columns, **faults, **laps}
    computed = start_cells, members, told, named, archive, cell_N
    return Finished(before, state, *computed, columns, seconds)


def rows(search: Search, finished: Finished, reachable: Reachable) -> tuple[HistoryRow, Table]:
    """A generation's row of the history, and the table of what it has evaluated."""
    state, before, told, cell_N = finished.state, finished.before, finished.told, finished.cell_N
    archive, measured = finished.archive, {**dict(search.config.novelty), "threads": 1}
    novelty_N = np.full(len(told), np.nan) if archive is None else novelty(archive, told.descriptor_N_B, **measured)
    table = evaluated_table(told, search.task, cell_N, finished.start_cells, novelty_N)
    at = fittest(told)  # subject of the history's row
    shown, infeasible = int(told.centre_N[at]), finished.members.infeasible
    of_map: HistoryRow = {}
    if state.search.map is not None and cell_N is not None:
        of_map = {
            "start_cell": finished.start_cells.get(shown),
            "cell": None if cell_N[at] == EMPTY else int(cell_N[at]),
            **map_statistics(state.search.map, search.config.map.qd_offset, reachable),
        }
    row: HistoryRow = {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "episodes": state.episodes,
        "best_fitness": state.best.fitness,
        "centre": shown,
        "fitness_weight": float(told.columns["fitness_weight"][at]),
        "centre_novelty": or_none(novelty_N[at]),
        "archive_size": state.search.archive.size,
        **of_map,
        "update_norm": or_none(told.columns["update_norm"][at]),
        "parameter_norm": norm(finished.named.policies([at])[at].parameters_D),
        **population_columns(finished.members.results, infeasible),
        **({"infeasible_members": infeasible} if search.config.search.allow_infeasible else {}),
        **evaluation_columns(table, results_in(told), at, search.task),
        **{f"{METRIC}{name}": or_none(float(of(state.search))) for name, of in search.algorithm.metrics.items()},
        "wall_clock_s": state.wall_clock_s,
        "rollout_s": or_none(state.rollout_s),
        "cpu_s": or_none(state.cpu_s),
        "steps_per_second": (state.env_steps - before.env_steps) / finished.seconds,
        **finished.columns,
    }
    return row, table
