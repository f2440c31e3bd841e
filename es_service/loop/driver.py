"""The main loop of a run: ask, roll out, weights, gradient, step, evaluate, tell, commit.

The loop is independent of Ray, JAX, files and any single method; everything that it works with is an argument. At any
time the store has the last finished generation, and the next one depends only on (config, seed, state).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from es_service.config.model import BudgetConfig
from es_service.loop import budget as budgets
from es_service.loop.changes import changed_parts
from es_service.loop.checks import (
    invalidate,
    require_asks,
    require_finite,
    require_some_finite,
    require_state,
    require_weights,
)
from es_service.loop.clock import Clock
from es_service.loop.evaluated import evaluated_rows, in_ask_order, policies_asked
from es_service.loop.generation import (
    better,
    centre_evaluation,
    entered,
    estimate_gradients,
    evaluate_centres,
    evaluate_populations,
    first_episode,
    fittest,
    make_centre,
    steps_of,
    tell,
)
from es_service.loop.history import (
    HistoryRow,
    Resets,
    evaluated_row,
    evaluation_columns,
    fault_columns,
    map_columns,
    population_columns,
    search_columns,
    step_columns,
)
from es_service.loop.interfaces import Search, Stop, Store, Stored
from es_service.loop.parts import ELITE_PREFIX, elite_from_arrays, elite_part, state_from_parts
from es_service.loop.policies import as_population
from es_service.loop.state import Best, RunState
from es_service.protocol.evaluator import DispatchCounts, Evaluator
from es_service.protocol.messages import TaskSpec
from es_service.search.algorithms.base import Ask
from es_service.search.algorithms.steps import first_state
from es_service.search.maps.behaviour_map import BehaviourMap, Elite, empty_map
from es_service.search.maps.geometry import make_geometry, reachable_cells
from es_service.search.novelty import novelty
from es_service.search.observation_statistics import merge_moments

Reachable = NDArray[np.bool_] | None
"""Whether each cell of the map can be reached, [cells]; None if this is unknown."""


def run(
    search: Search,
    evaluator: Evaluator,
    store: Store,
    state: RunState | None,
    report: Callable[[HistoryRow], object],
) -> tuple[RunState, str]:
    """Run generations until the budget is spent or `report` returns a `Stop`.

    Args:
        state: the newest state in `store`, from which to continue; None to begin a run, with an empty store.
        report: called with each history row after it has been committed. A `Stop` that it returns ends the session, and
            any other value has no effect.

    Returns:
        The last state and the reason for ending, in words.

    Raises:
        EvaluationError, StoreError: the run cannot continue; nothing committed is lost.
        Interrupted: a signal asked the run to stop.
    """
    budget = search.config.budget
    clock, answer = Clock(0.0), None
    if state is None:
        map_ = None
        if search.config.map.enabled:
            map_ = empty_map(make_geometry(search.config.map), counts_samples=search.algorithm.counts_samples)
        reachable = _reachable(search, map_)
        first = _first_generation(search, evaluator, clock, map_, reachable)
        state, answer = _keep(store, report, clock, None, *first)
    else:
        reachable = _reachable(search, state.search.map)
        clock = Clock(state.wall_clock_s)
    while (reason := answer.reason if isinstance(answer, Stop) else spent(budget, state)) is None:
        following = _next_generation(search, evaluator, store, clock, state, reachable)
        state, answer = _keep(store, report, clock, state, *following)
    return state, reason


def stored_state(store: Stored, task: TaskSpec) -> RunState | None:
    """The newest state in the store, without the elites' policies; None before the first generation."""
    if store.generation is None:
        return None
    seconds = float((store.last_history() or {}).get("wall_clock_s") or 0.0)
    parts = store.load(without=ELITE_PREFIX)
    return state_from_parts(parts, store.generation, seconds, len(task.descriptor_names))


def spent(budget: BudgetConfig, state: RunState) -> str | None:
    """Why the run is over, or None if it is not."""
    reached = {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "wall_clock_s": state.wall_clock_s,
        "best_fitness": state.best.fitness,
    }
    return next(iter(budgets.spent(budgets.limits_of(budget), reached).values()), None)


def _first_generation(
    search: Search, evaluator: Evaluator, clock: Clock, map_: BehaviourMap | None, reachable: Reachable
) -> tuple[RunState, HistoryRow, list[HistoryRow]]:
    """Evaluate the initial centres, which is generation 0. Its row of the history describes the fittest of them."""
    config, algorithm = search.config, search.algorithm
    centres, observations = search.initial()
    learned = first_state(centres, len(search.task.descriptor_names), algorithm.fitness_weight, map_, algorithm.own)
    points = [make_centre(config, 0, centre_D, observations) for centre_D in centres]
    evaluations = evaluate_centres(evaluator, points, config.search.evaluation_episodes, resets="by_chunk")
    clock.lap("seconds_evaluation")
    require_some_finite(evaluations, config.task.environment)
    told = tuple(centre_evaluation(0, centre, evaluation) for centre, evaluation in enumerate(evaluations))
    learned = tell(algorithm, learned, told)
    shown = fittest(told)
    first = Best(0, -math.inf, centres[0], points[0].observation_mean_O, points[0].observation_std_O)
    state = RunState(
        generation=0,
        search=replace(learned, elites={}),
        observations=observations,
        best=better(first, points, told),
        env_steps=sum(map(steps_of, evaluations)),
        episodes=sum(evaluation.fitness.size for evaluation in evaluations),
        wall_clock_s=clock.total(),
        elites=entered(learned, told, points, evaluations),
    )
    row: HistoryRow = {
        **search_columns(shown, algorithm.fitness_weight, None, learned.archive.size),
        **map_columns(learned.map, config.map.qd_offset, reachable, generation=0, centre=shown, start_cell=None),
        **step_columns(None, centres[shown]),
        **population_columns(()),
        **evaluation_columns(evaluations[shown], search.task),
        **fault_columns(evaluator.counts, since=DispatchCounts()),
    }
    rows = [
        evaluated_row(
            evaluation,
            search.task,
            learned.map,
            resets=Resets(config.seed, first_episode(centre, config.search.evaluation_episodes)),
            generation=0,
            centre=centre,
            fitness_weight=algorithm.fitness_weight,
            start_cell=None,
            novelty=None,
            update_norm=None,
            env_steps=steps_of(evaluation),
        )
        for centre, evaluation in enumerate(evaluations)
    ]
    return state, row, rows


def _next_generation(
    search: Search, evaluator: Evaluator, store: Store, clock: Clock, state: RunState, reachable: Reachable
) -> tuple[RunState, HistoryRow, list[HistoryRow]]:
    """One generation: a pure function of (search, state, elites in the store) but for its timings.

    It may ask for several populations, and for policies. Each phase runs all of them side by side; results are taken in
    ask order.
    """
    config, algorithm = search.config, search.algorithm
    settings, sizes = config.search, config.compute
    generation = state.generation + 1
    counts = evaluator.counts

    begun = state.search
    start_cells = algorithm.start_cells(begun, generation)
    for index, cell in start_cells.items():
        begun = algorithm.restart(begun, index, cell, _elite(store, cell))
    parents = {cell: _elite(store, cell) for cell in algorithm.parents(begun, generation)}
    asked = algorithm.ask(replace(begun, elites=parents), generation)
    require_asks(asked, begun, sizes.chunk_pairs, search.task.observation_size, generation)
    asks = [ask for ask in asked if isinstance(ask, Ask)]
    policies = policies_asked(config, search.task, generation, asked)
    centres = [
        make_centre(config, generation, ask.centre_D, state.observations, begun.centres[ask.centre], ask.sigma)
        for ask in asks
    ]
    clock.lap("seconds_driver")
    pairs = [ask.pairs for ask in asks]
    populations, observed, found = evaluate_populations(evaluator, centres, pairs, sizes.chunk_pairs, policies)
    clock.lap("seconds_rollout")
    members = [*populations, *map(as_population, found)]
    members = invalidate(members, settings.max_invalid_fraction, generation)
    populations = members[: len(asks)]
    weights = [algorithm.weights(begun, *told) for told in zip(asks, populations, strict=True)]
    for ask, weights_P in zip(asks, weights, strict=True):
        require_weights(weights_P, ask, generation)
    clock.lap("seconds_driver")
    gradients = estimate_gradients(evaluator, generation, weights, sizes.gradient_block_pairs)
    clock.lap("seconds_gradient")
    moved = begun
    for ask, gradient_D in zip(asks, gradients, strict=True):
        moved = algorithm.step(moved, ask, gradient_D)
        require_state(moved, "step", generation)
    # New centres are evaluated with the observation statistics of the generation's start.
    new_centres = [
        replace(centre, parameters_D=moved.centres[ask.centre].centre_D)
        for ask, centre in zip(asks, centres, strict=True)
    ]
    require_finite(new_centres, settings.learning_rate, generation)
    clock.lap("seconds_driver")
    evaluations = evaluate_centres(evaluator, new_centres, settings.evaluation_episodes)
    clock.lap("seconds_evaluation")
    evaluated = in_ask_order(
        asked,
        zip(new_centres, evaluations, populations, strict=True),
        zip(policies, found, strict=True),
        seed=config.seed,
        generation=generation,
        centres=len(begun.centres),
        fitness_weight=begun.weight.value,
    )
    told = tuple(centre_evaluation(generation, one.index, one.evaluation, one.population) for one in evaluated)
    learned = tell(algorithm, moved, told)

    nearest, descriptors = config.novelty, [one.descriptor_B for one in told]
    novelties = novelty(
        moved.archive, descriptors, neighbours=nearest.neighbours, distance=nearest.distance, newest=nearest.newest
    ).tolist()
    rows = evaluated_rows(evaluated, search.task, learned.map, generation, start_cells, novelties)
    at = fittest(told)
    shown = evaluated[at]  # the history's row is about this one
    row: HistoryRow = {
        **search_columns(shown.index, shown.fitness_weight, novelties[at], learned.archive.size),
        **map_columns(
            learned.map,
            config.map.qd_offset,
            reachable,
            generation=generation,
            centre=shown.index,
            start_cell=start_cells.get(shown.index),
        ),
        **step_columns(shown.before_D, shown.point.parameters_D),
        **population_columns(members),
        **evaluation_columns(shown.evaluation, search.task),
        **fault_columns(evaluator.counts, since=counts),
    }
    points, evaluations = [one.point for one in evaluated], [one.evaluation for one in evaluated]
    state = RunState(
        generation=generation,
        search=replace(learned, elites={}),
        observations=merge_moments(state.observations, observed),
        best=better(state.best, points, told),
        env_steps=state.env_steps + sum(one.env_steps for one in evaluated),
        episodes=state.episodes
        + sum(population.fitness.size for population in populations) * config.task.episodes_per_member
        + sum(evaluation.fitness.size for evaluation in evaluations),
        wall_clock_s=clock.total(),
        elites=entered(learned, told, points, evaluations),
    )
    return state, row, rows


def _keep(
    store: Store,
    report: Callable[[HistoryRow], object],
    clock: Clock,
    before: RunState | None,
    state: RunState,
    row: HistoryRow,
    evaluations: list[HistoryRow],
) -> tuple[RunState, object]:
    """Commit a finished generation, then report it; returns its state and what `report` returns."""
    clock.lap("seconds_driver")
    seconds, laps = clock.finish_generation()
    steps = state.env_steps - (before.env_steps if before else 0)
    row = {
        "generation": state.generation,
        "env_steps": state.env_steps,
        "episodes": state.episodes,
        "best_fitness": state.best.fitness,
        **row,
        "wall_clock_s": state.wall_clock_s,
        "steps_per_second": steps / seconds,
        **laps,
    }
    store.commit(state.generation, changed_parts(state, before, store.part), row, evaluations)
    clock.lap("seconds_store")
    return state, report(row)


def _elite(store: Store, cell: int) -> Elite:
    return elite_from_arrays(store.part(elite_part(cell)))


def _reachable(search: Search, map_: BehaviourMap | None) -> Reachable:
    return None if map_ is None else reachable_cells(map_.geometry, search.task)
