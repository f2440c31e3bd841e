"""Functions that the search algorithms share; the file of each algorithm says which it uses.

Axes: M centres of the search (C is the axis of a cvt map's centroids), N entries of the novelty archive, P antithetic
pairs, S signs [+, -], B descriptor dimensions, D policy parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import RunConfig
from es_service.config.parts import Objective
from es_service.config.search import PopulationConfig, SearchConfig
from es_service.config.sections import NoveltyConfig
from es_service.errors import StoreError
from es_service.protocol.content import Policy
from es_service.protocol.messages import EpisodesResult, FloatArray
from es_service.protocol.nearest import NOVELTY
from es_service.protocol.noise import Domain, stream_keys, uniforms
from es_service.search.algorithms.base import (
    NO_CELL,
    NO_ENTRY,
    Algorithm,
    Ask,
    CentreEvaluation,
    CentreState,
    FitnessWeight,
    SearchState,
    in_columns,
    with_centre,
)
from es_service.search.algorithms.settings import CentresSettings, settings_of
from es_service.search.arrays import read_only
from es_service.search.maps.behaviour_map import BehaviourMap, changed, insert, insert_each
from es_service.search.maps.geometry import Dominated, cell_count
from es_service.search.novelty import NoveltyArchive, empty_archive, extended, novelty
from es_service.search.shaping import pair_weights, utilities, weight_of_fitness, weighted
from es_service.search.steps import STEPS, fresh_state

CENTRE_CHOICE = 0
"""Last id of the random streams of Domain.SELECTION that choose the centre to update."""

AdaptWeight = Callable[[FitnessWeight, Sequence[CentreEvaluation]], FitnessWeight]
Offer = Callable[[SearchState, Sequence[CentreEvaluation]], SearchState]
"""(state, evaluations of a generation) -> state with them in the novelty archive and in the behaviour map."""


def novelty_search(
    config: RunConfig, fitness_weight: float, adapt: AdaptWeight | None = None, offer: Offer | None = None
) -> Algorithm:
    """An algorithm of the family of Conti et al. 2018: ES on the utility (1 - w) * shaped novelty + w * shaped fitness.

    A generation updates one centre, or all, as the keys of `CentresSettings` say; without these, one by novelty.

    Args:
        fitness_weight: initial value of w.
        adapt: (weight, evaluations of a generation after 0) -> new weight; None for a constant w.
        offer: what becomes of evaluated centres; None: `add_to_archive_and_map`.
    """
    search = settings_of(config, PopulationConfig)
    updates_all = isinstance(search, CentresSettings) and search.update == "all"

    def ask(state: SearchState, generation: int) -> tuple[Ask, ...]:
        chosen = range(len(state.centres)) if updates_all else [choose_centre(state, generation, config)]
        objective = weighted(state.weight.value)
        return tuple(population(state, index, search, objective, generation) for index in chosen)

    def weights(state: SearchState, asked: Ask, population: EpisodesResult) -> NDArray[np.float32]:
        objective = asked.objective or weighted(asked.fitness_weight)
        known_P_S = population.outputs.get(NOVELTY)  # in the same archive: steps do not change it
        return pair_weights(utilities(objective, population, state.archive, config.novelty, search.shaping, known_P_S))

    def step(state: SearchState, asked: Ask, gradient_D: FloatArray) -> SearchState:
        return step_centre(state, asked, gradient_D, search)

    def tell(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
        weight = state.weight
        if adapt is not None and evaluations[0].generation > 0:
            weight = adapt(weight, evaluations)
        return replace((offer or add_to_archive_and_map)(state, evaluations), weight=weight)

    return Algorithm(ask, tell, weights, step, fitness_weight)


def population(state: SearchState, index: int, search: PopulationConfig, objective: Objective, generation: int) -> Ask:
    """The population around a centre, with the settings of the config and the values of its schedules in a generation.

    Args:
        objective: what its members are ranked by.
        generation: counted from 1.
    """
    sigma = scheduled(search.sigma, search.sigma_decay, search.sigma_limit, generation)
    rate = search.step.learning_rate
    share = scheduled(rate, search.learning_rate_decay, search.learning_rate_limit, generation) / rate
    centre_D = state.centres[index].centre_D
    return Ask(index, centre_D, sigma, search.pairs, weight_of_fitness(objective), objective, share)


def scheduled(start: float, decay: float, limit: float, generation: int) -> float:
    """Value of a schedule in a generation, counted from 1: start * decay^(generation - 1), but never below the limit.

    A limit above the start has no effect. Source: the schedules of evosax and EvoJAX.
    """
    return max(start * decay ** (generation - 1), min(start, limit))


def first_state(
    centres: Sequence[FloatArray],
    dimensions: int,
    fitness_weight: float,
    map_: BehaviourMap | None = None,
    extra: Mapping[str, Any] | None = None,
    search: SearchConfig | None = None,
) -> SearchState:
    """The state before any evaluation: initial centres, none of which has made a step, and an empty novelty archive.

    Args:
        centres: parameters of each initial centre, [D] each.
        dimensions: number of descriptor dimensions.
        fitness_weight: initial weight of fitness.
        map_: the empty behaviour map; None for a run without one.
        extra: `Algorithm.extra`.
        search: settings with the kind of the steps; None for a search without steps.
    """
    states = tuple(CentreState(centre_D, fresh_state(search, centre_D.size)) for centre_D in centres)
    return SearchState(states, empty_archive(dimensions), FitnessWeight(fitness_weight), map_, read_only(extra or {}))


def choose_centre(state: SearchState, generation: int, config: RunConfig) -> int:
    """Index of the centre to update in a generation, by `search.centre_choice`; without that key, by novelty.

    novelty: with probability proportional to the centre's novelty in the present novelty archive; a centre without a
    valid evaluation counts as the most novel one; if all novelties are 0, all have the same probability.
    uniform: all with the same probability. round_robin: in turn, starting with centre 0 in generation 1.
    """
    count, search = len(state.centres), config.search
    how = search.centre_choice if isinstance(search, CentresSettings) else "novelty"
    if count == 1:
        return 0
    if how == "round_robin":
        return (generation - 1) % count
    share_M = np.ones(count)
    if how == "novelty":
        novelty_M = novelty_of_centres(state, config.novelty)
        # Otherwise a centre whose first evaluation failed would never be selected again.
        novelty_M[[centre.entry == NO_ENTRY for centre in state.centres]] = novelty_M.max()
        share_M = novelty_M if novelty_M.any() else share_M
    key = stream_keys(config.seed, Domain.SELECTION, generation, CENTRE_CHOICE)
    drawn = float(uniforms(key, np.zeros(1, np.uint32))[0])
    cumulative_M = np.add.accumulate(share_M)
    return int(np.searchsorted(cumulative_M, drawn * cumulative_M[-1], side="right"))


def novelty_of_centres(state: SearchState, settings: NoveltyConfig) -> NDArray[np.float64]:
    """Novelty of each centre's newest entry in the novelty archive without that entry, [M]; 0 if it has no entry."""
    novelty_M = np.zeros(len(state.centres))
    entry_M = np.array([centre.entry for centre in state.centres])
    known_M = np.flatnonzero(entry_M != NO_ENTRY)
    novelty_M[known_M] = novelty(
        state.archive, state.archive.descriptor_N_B[entry_M[known_M]], **dict(settings), exclude_Q=entry_M[known_M]
    )
    return novelty_M


def step_centre(state: SearchState, asked: Ask, gradient_D: FloatArray, search: PopulationConfig) -> SearchState:
    """The state after one step of the asked centre up the gradient estimate [D], by its own `search.step`. Raises
    StoreError if the centre lacks what the step remembers, as in a run that somebody else has written."""
    centre = state.centres[asked.centre]
    settings = search.step
    if asked.rate != 1.0:
        settings = settings.model_copy(update={"learning_rate": settings.learning_rate * asked.rate})
    try:
        step, centre_D = STEPS[settings.kind].take(settings, centre.step, centre.centre_D, gradient_D)
    except KeyError as error:
        what = f"centre {asked.centre} lacks {error}, which a step of search.step.kind = {settings.kind} remembers"
        raise StoreError(what) from error
    return with_centre(state, asked.centre, replace(centre, centre_D=centre_D, step=step))


def add_to_archive_and_map(state: SearchState, evaluations: Sequence[CentreEvaluation]) -> SearchState:
    """The state with the evaluated centres in the novelty archive and in the behaviour map, one after another; in a map
    of slots they compete at once."""
    each = tuple(evaluations)  # which are made when a sequence of columns is asked for them
    for evaluation in each:
        state = add_to_archive(state, evaluation)
    if (map_ := state.map) is not None and isinstance(map_.geometry, Dominated):
        return _compete(state, map_, evaluations)
    for evaluation in each:
        state = insert_into_map(state, evaluation)
    return state


def add_to_archive(state: SearchState, evaluation: CentreEvaluation) -> SearchState:
    """The state with a valid centre appended to the novelty archive; unchanged for an invalid centre."""
    if not evaluation.valid:
        return state
    archive = extended(state.archive, evaluation.descriptor_B, evaluation.generation, evaluation.centre)
    centre = replace(state.centres[evaluation.centre], entry=archive.size - 1)
    return replace(with_centre(state, evaluation.centre, centre), archive=archive)


def insert_into_map(state: SearchState, evaluation: CentreEvaluation) -> SearchState:
    """The state with a valid centre inserted into the behaviour map, if it is better than the elite of its cell.

    `CentreState.cell` is then the cell whose elite the centre is, or NO_CELL. If the centre was an elite before this
    generation, that elite first gets a new score: the highest fitness of the population around it. A centre whose elite
    is replaced is no elite any more.
    """
    centre, map_ = state.centres[evaluation.centre], state.map
    if map_ is None:
        return state
    if centre.cell != NO_CELL and np.isfinite(evaluation.population_max):
        map_ = changed(map_, centre.cell, score=evaluation.population_max)
    cell = NO_CELL
    if evaluation.valid:
        map_, offered, entered = insert(
            map_,
            evaluation.descriptor_B,
            evaluation.fitness,
            evaluation.generation,
            evaluation.centre,
            evaluation.population_max,
            evaluation.episodes,
        )
        cell = offered if entered else NO_CELL
    centres = [
        replace(other, cell=NO_CELL) if cell != NO_CELL and other.cell == cell else other for other in state.centres
    ]
    centres[evaluation.centre] = replace(centre, cell=cell)
    return replace(state, centres=tuple(centres), map=map_)


def _compete(state: SearchState, map_: BehaviourMap, evaluations: Sequence[CentreEvaluation]) -> SearchState:
    """The state after the evaluations of all centres for a map of slots; scores and cells as in `insert_into_map`."""
    for evaluation in evaluations:
        cell = state.centres[evaluation.centre].cell
        if cell != NO_CELL and np.isfinite(evaluation.population_max):
            map_ = changed(map_, cell, score=evaluation.population_max)
    told = in_columns(evaluations)
    valid = told.valid_N
    columns = told.centre_N[valid], told.population_max_N[valid]
    map_ = insert_each(
        map_, told.descriptor_N_B[valid], told.fitness_N[valid], told.generation, *columns, told.episodes
    )
    cell_N = map_.cells_with(told.generation, told.centre_N)  # in which EMPTY is NO_CELL
    for index, cell in zip(told.centre_N.tolist(), cell_N.tolist(), strict=True):
        state = with_centre(state, index, replace(state.centres[index], cell=cell))
    return replace(state, map=map_)


Starts = Literal["uniform", "novelty", "least_tried", "fitness"]
Restart = Callable[[SearchState, int, int, Policy], SearchState]
TRIED = "tried"
"""Name of an array of the search's own [cells]: number of centres that have begun from each cell."""


def counted_starts(config: RunConfig) -> dict[str, NDArray[np.int64]]:
    """The array TRIED before any start."""
    return {TRIED: np.zeros(cell_count(config.map), np.int64)}


def counting(restart: Restart) -> Restart:
    """The same function, which also counts the start if the search counts them."""

    def counted(state: SearchState, index: int, cell: int, elite: Policy) -> SearchState:
        if (tried_C := state.extra.get(TRIED)) is not None:
            tried_C = tried_C + (np.arange(tried_C.size) == cell)
            state = replace(state, extra=read_only({**state.extra, TRIED: tried_C}))
        return restart(state, index, cell, elite)

    return counted


def start_shares(
    starts: Starts,
    map_: BehaviourMap,
    archive: NoveltyArchive,
    settings: NoveltyConfig,
    tried_C: NDArray[np.int64] | None,
) -> NDArray[np.float64]:
    """Relative probability with which each filled cell is drawn, [N].

    uniform: all the same. novelty: in proportion to the novelty of the elite. least_tried: the cells from which the
    fewest centres have begun. fitness: in proportion to the fitness above the lowest. If all shares would be 0, all
    have the same.

    Args:
        settings: how novelty is computed.
        tried_C: number of centres that have begun from each cell, [cells]; used by least_tried alone.
    """
    share_N = np.ones(map_.size)
    if starts == "novelty":
        share_N = elite_novelty(map_, archive, settings)
    elif starts == "least_tried":
        assert tried_C is not None, "the search counts starts"
        tried_N = tried_C[map_.cell_N]
        share_N = (tried_N == tried_N.min()).astype(np.float64)
    elif starts == "fitness":
        share_N = map_.fitness_N.astype(np.float64) - map_.fitness_N.min()
    return share_N if share_N.any() else np.ones(map_.size)


def drawn_cell(map_: BehaviourMap, share_N: NDArray[np.float64], uniform: float) -> int:
    """The cell that a uniform random number in [0, 1) draws."""
    cumulative_N = np.add.accumulate(share_N)
    return int(map_.cell_N[np.searchsorted(cumulative_N, uniform * cumulative_N[-1], side="right")])


def elite_novelty(map_: BehaviourMap, archive: NoveltyArchive, settings: NoveltyConfig) -> NDArray[np.float64]:
    """Novelty of each elite's descriptor in the novelty archive without the elite's own entry, [N]."""
    return novelty(archive, map_.descriptor_N_B, **dict(settings), exclude_Q=_entries_of_elites(map_, archive))


def _entries_of_elites(map_: BehaviourMap, archive: NoveltyArchive) -> NDArray[np.int64]:
    """Index of each elite's own entry in the novelty archive, [N]; -1 for an elite without one.

    Entries are in the order of the asks, which need not be that of the centres.
    """
    centres = 1 + max(map_.centre_N.max(initial=0), archive.centre_N.max(initial=0))
    entry_N, elite_N = (entries.generation_N * centres + entries.centre_N for entries in (archive, map_))
    order = np.argsort(entry_N, kind="stable")
    found_N = np.append(order, -1)[np.searchsorted(entry_N, elite_N, sorter=order)]
    return np.where(np.append(entry_N, -1)[found_N] == elite_N, found_N, -1)
